"""Breathing series with the truth of every state: a driver is shown both ends of the breath and the volumes between.

Ref: Eom 2010, section III D and table VIII (intermediate phases, beside linear interpolation).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from poro.arrays import Array
from registration.volume import Mask
from vatsloc.breathing.case import BreathCase, Scan
from vatsloc.breathing.motion import OUT, Motion
from vatsloc.breathing.run import run_driver
from vatsloc.breathing.signal import PERIOD_S
from vatsloc.errors import CaseError
from vatsloc.formats.guard import reading
from vatsloc.formats.images import read_volume
from vatsloc.imaging.lungs import lung_halves
from vatsloc.synthetic.series import SERIES_FILE


@dataclass(frozen=True)
class Series:
    """A breath from the end of inspiration and back to it. case: both ends, and the volumes as its signal; volume: (n,)
    in every state, 0 expiration to 1 inspiration; truth: (n, k, 3) the same tissue in every state, RAS mm. The last
    state is the first one again.
    """

    case: BreathCase
    volume: Array
    truth: Array

    @property
    def deepest(self) -> int:
        """State of the expiration."""
        return int(np.argmin(self.volume))


def is_series(folder: Path) -> bool:
    """Whether a folder holds a breathing series."""
    return (folder / SERIES_FILE).is_file()


def read_series(folder: Path) -> Series:
    """The series that `vatsloc phantom --from-ct FILE --series N` wrote. Raises CaseError for missing or wrong files.

    Of the images a driver sees those of both ends; of the states between it knows the volume that was asked for.
    """
    with reading(folder / SERIES_FILE, "breathing series", "write it with vatsloc phantom --series"):
        info = json.loads((folder / SERIES_FILE).read_text(encoding="utf-8"))
        ratio, side = np.array(info["volume"], float), str(info["side"])
    ratio = np.append(ratio, ratio[0])
    volume = (ratio - ratio.min()) / (ratio.max() - ratio.min())
    if volume[0] < 1:
        raise CaseError(f"{folder} does not begin at the end of inspiration; write it with vatsloc phantom --series.")
    files = [*range(len(ratio) - 1), 0]
    truth = np.stack([np.loadtxt(folder / f"truth_{n:03d}.csv", delimiter=",", skiprows=1)[:, 3:] for n in files])
    ends = [_scan(folder, name, n, side) for name, n in (("inspiration", 0), ("expiration", int(ratio.argmin())))]
    signal = np.column_stack([np.linspace(0.0, PERIOD_S, len(ratio)), volume])
    return Series(BreathCase(folder.resolve().name, folder, ends[0], ends[1], signal, None), volume, truth)


def bench_series(series: Series, driver: str, masks_alone: bool) -> tuple[Motion, dict[str, Any]]:
    """A driver along the series, and its errors in mm (see `errors`)."""
    case = replace(series.case, masks_alone=masks_alone)
    motion = run_driver(case, driver, len(series.volume), lambda _: None)
    return motion, errors(motion, series)


def errors(motion: Motion, series: Series) -> dict[str, Any]:
    """Means over the truth's points, mm. initial_mean, mean, p95: motion to the other end, and what is left of it;
    phases: what is left at every intermediate state, in mean and at the worst, then by the straight line between the
    driver's own ends at the state's volume, and between the true ends; loop: how far the last state is from the first.
    """
    deepest, truth = series.deepest, series.truth
    first = 0 if motion.direction == OUT else deepest
    moved = np.stack([motion.moved(truth[first], n) for n in range(motion.count)])
    share = 1 - series.volume if motion.direction == OUT else series.volume
    other = deepest if motion.direction == OUT else 0
    between = np.flatnonzero((series.volume > 0.02) & (series.volume < 0.98))
    left = _left(moved, truth)
    own = _left(_straight(moved[first], moved[other], share), truth)
    true = _left(_straight(truth[first], truth[other], share), truth)
    return {
        "initial_mean": float(np.linalg.norm(truth[other] - truth[first], axis=1).mean()),
        "mean": float(left[other].mean()),
        "p95": float(np.percentile(left[other], 95)),
        "n": truth.shape[1],
        "phases": {
            "n": len(between),
            "mean": float(left[between].mean()),
            "worst": float(left[between].mean(axis=1).max()),
            "straight": float(own[between].mean()),
            "straight_between_true_ends": float(true[between].mean()),
        },
        "loop": float(np.linalg.norm(moved[-1] - moved[0], axis=1).max()),
    }


def series_table(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of text, one per series and driver."""
    head = f"{'series':14s}{'driver':20s}{'by':>8s}{'motion':>8s}{'left':>7s}{'phases':>8s}{'worst':>7s}"
    lines = [head + f"{'straight':>10s}{'true ends':>11s}{'loop':>7s}{'s':>6s}"]
    for row in rows:
        at = row["phases"]
        lines.append(
            f"{row['name']:14s}{row['driver']:20s}{row['by']:>8s}{row['initial_mean']:8.1f}{row['mean']:7.2f}"
            f"{at['mean']:8.2f}{at['worst']:7.2f}{at['straight']:10.2f}{at['straight_between_true_ends']:11.2f}"
            f"{row['loop']:7.3f}{row['seconds']:6.0f}"
        )
    return lines


def _left(moved: Array, truth: Array) -> Array:
    return np.asarray(np.linalg.norm(moved - truth, axis=2))


def _straight(start: Array, end: Array, share: Array) -> Array:
    return np.asarray(start + share[:, None, None] * (end - start))


def _scan(folder: Path, name: str, number: int, side: str) -> Scan:
    image = read_volume(folder / f"state_{number:03d}.nii.gz")
    work, _, halves, _ = lung_halves(image)
    return Scan(name, image, Mask(halves["left" if side == "left" else "right"], work.ras_from_ijk))
