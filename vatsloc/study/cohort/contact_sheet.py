"""A picture of many cases side by side: the CT, the inflated and the collapsed lung, cut through the nodule."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from registration.volume import Array, Volume
from vatsloc.errors import CaseError
from vatsloc.formats.images import read_volume
from vatsloc.formats.markups import read_points
from vatsloc.report.paint import grey
from vatsloc.report.planes import box_of, plane_through, sample

WINDOW_HU = (-1150.0, 350.0)
PIXEL_MM = 2.0
HEIGHT, MARGIN, LABEL = 170, 4, 18
_PANELS = (
    ("ct.nii.gz", "nodule_ct.mrk.json", "axial"),
    ("ct.nii.gz", "nodule_ct.mrk.json", "coronal"),
    ("cbct_inflated.nii.gz", "truth/nodule_cbct_inflated.mrk.json", "coronal"),
    ("cbct_deflated.nii.gz", "truth/nodule_cbct_deflated.mrk.json", "coronal"),
    ("cbct_deflated.nii.gz", "truth/nodule_cbct_deflated.mrk.json", "sagittal"),
    ("cbct_deflated.nii.gz", "truth/nodule_cbct_deflated.mrk.json", "axial"),
)


def write_sheet(cases: Sequence[Path], out: Path, columns: int = 2, beside: Path | None = None) -> None:
    """Write a PNG or JPEG with a row of six cuts for every case folder, `columns` cases beside each other.

    beside: a case made from a real scan, shown first. Raises CaseError where the picture cannot be written so.
    """
    if out.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise CaseError(f"{out.name} is no picture's name; end it in .png or .jpg.")
    shown = ([] if beside is None else [beside]) + list(cases)
    strips = [_strip(case) for case in shown]
    width = max(s.shape[1] for s in strips)
    strips = [np.pad(s, ((0, 0), (0, width - s.shape[1]))) for s in strips]
    strips += [np.zeros_like(strips[0])] * (-len(strips) % columns)
    rows = [np.hstack(strips[n : n + columns]) for n in range(0, len(strips), columns)]
    quality = [] if out.suffix.lower() == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 42]
    if not cv2.imwrite(str(out), np.vstack(rows), quality):
        raise CaseError(f"{out} cannot be written; check that its folder exists.")


def _strip(case: Path) -> Array:
    """The cuts of one case in a row under its name, grey values (rows, columns)."""
    panels = [_cut(read_volume(case / image), read_points(case / at).ras[0], plane) for image, at, plane in _PANELS]
    strip = np.hstack([np.pad(p, ((LABEL, 0), (0, MARGIN))) for p in panels])
    cv2.putText(strip, case.name, (4, LABEL - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 230, 1, cv2.LINE_AA)
    return strip


def _cut(image: Volume, at_ras: Array, name: str) -> Array:
    """One plane through a point (3,), grey values of fixed height."""
    pixels = grey(sample(image, plane_through(name, at_ras, box_of(image.grid), PIXEL_MM / 2)), WINDOW_HU)
    scale = HEIGHT / pixels.shape[0]
    return cv2.resize(pixels, (round(pixels.shape[1] * scale), HEIGHT), interpolation=cv2.INTER_AREA)
