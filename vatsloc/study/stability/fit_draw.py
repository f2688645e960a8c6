"""The disturbed runs as a picture: error by disturbance and case, and which of them a gate flagged."""

from __future__ import annotations

from pathlib import Path

from vatsloc.study.chart.draw import require_matplotlib
from vatsloc.study.tables import Row


def draw_disturbed(rows: list[Row], silent_mm: float, file: Path) -> None:
    """Write a dot for every run to `file`, a PNG: mean error at the landmarks, hollow where a gate flagged it.

    Runs that gave no answer have no dot. Raises CaseError without matplotlib.
    """
    require_matplotlib()
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(dict.fromkeys(str(row["disturbed"]) for row in rows))
    figure, axes = pyplot.subplots(figsize=(8, 1.2 + 0.4 * len(names)), layout="constrained")
    for number, case in enumerate(dict.fromkeys(str(row["case"]) for row in rows)):
        colour = f"C{number}"
        answered = [row for row in rows if row["case"] == case and row["landmarks_mm"] != ""]
        for flagged in (False, True):
            chosen = [row for row in answered if bool(row["flagged"]) == flagged]
            axes.scatter(
                [row["landmarks_mm"] for row in chosen],
                [names.index(str(row["disturbed"])) + 0.12 * number for row in chosen],
                facecolors="none" if flagged else colour,
                edgecolors=colour,
                label=f"{case}, flagged" if flagged else case,
            )
    axes.axvline(silent_mm, color="grey", linestyle=":")
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel(f"mean error at the landmarks, mm (beyond {silent_mm:g} a failure)")
    axes.legend(fontsize="small", loc="center right")
    figure.savefig(file, dpi=110)
    pyplot.close(figure)
