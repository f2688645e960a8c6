"""Errors of predicted landmarks of real lungs as arrows, from the side and from the front."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from poro.breathing.elastic import caudal
from poro.mesh import interpolate, locate
from vatsloc.study.bench.breaths import read_person
from vatsloc.study.bench.real import BREATHING, ELASTIC, ROWS
from vatsloc.study.chart.draw import require_matplotlib

VIEWS = ((1, 2, "from the side, front to the right"), (0, 2, "from the front"))


def draw_real(folders: Sequence[Path], file: Path) -> None:
    """Write a PNG: for each lung, arrows from predicted to true places at expiration, over the expired surface's
    points.

    Raises CaseError without matplotlib, the extra `report`.
    """
    require_matplotlib()
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    people = [read_person(folder) for folder in folders]
    count = sum(len(person.lungs) for person in people)
    figure, axes = pyplot.subplots(count, 4, figsize=(17, 4.5 * count), squeeze=False)
    rows = iter(axes)
    for person in people:
        for lung in person.lungs:
            row = next(rows)
            marks = person.marks(lung.side)
            where = locate(lung.inspired, marks.inspired)
            shell = lung.expired.boundary.points
            for column, name in enumerate((ELASTIC, BREATHING)):
                there = marks.inspired + interpolate(where, ROWS[name](lung) - lung.inspired.points)
                for axis, (i, j, view) in zip(row[2 * column : 2 * column + 2], VIEWS, strict=True):
                    axis.scatter(shell[:, i], shell[:, j], s=1, color="#b8c0c8")
                    error = marks.expired - there
                    axis.quiver(
                        there[:, i], there[:, j], error[:, i], error[:, j], angles="xy", scale_units="xy", scale=1
                    )
                    axis.set_aspect("equal")
                    if caudal(lung.inspired) > 0:
                        axis.invert_yaxis()
                    axis.set_title(f"{person.name} {lung.side}, {view}\n{name}", fontsize=9)
    figure.tight_layout()
    figure.savefig(file, dpi=55)
    pyplot.close(figure)
