"""A case folder with small images of a chest, which tests change before they read it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from registration.volume import Grid, Mask, Volume
from vatsloc.case import read_case
from vatsloc.errors import VatslocError
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.nifti import write_mask, write_volume

IMAGES = {"ct": "ct.nii.gz", "cbct_inflated": "cbct_inflated.nii.gz", "cbct_deflated": "cbct_deflated.nii.gz"}
CENTRE = np.array([60.0, 10.0, -20.0])


def grid_at(centre=(0.0, 0.0, 0.0), spacing=10.0, n=(20, 18, 16)) -> Grid:
    """LPS-stored grid around a RAS point."""
    affine = np.diag([-spacing, -spacing, spacing, 1.0])
    affine[:3, 3] = np.asarray(centre) - affine[:3, :3] @ ((np.array(n) - 1) / 2)
    return Grid(n, affine)


def chest(grid: Grid) -> Volume:
    """Body of soft tissue in air, with a slope that tells the axes apart."""
    points = grid.points()
    body = np.linalg.norm(points / [80, 60, 200], axis=-1) < 1
    hu = np.where(body, 40 + 0.1 * points @ [1.0, 2, 3], -1000).astype(np.float32)
    return Volume(np.rint(hu), grid.ras_from_ijk)


def ball(grid: Grid, centre=CENTRE, radius=12.0) -> Mask:
    return Mask(np.linalg.norm(grid.points() - centre, axis=-1) <= radius, grid.ras_from_ijk)


def point(path: Path, *xyz: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    write_points(path, PointList(np.array(xyz), tuple(f"L{n}" for n in range(len(xyz)))))


def write_toml(folder: Path, **tables) -> None:
    """case.toml with the required tables unless they are given; None leaves one out."""
    tables = {"side": "right", "images": IMAGES, "nodule": {"mask": "nodule.nii.gz"}, **tables}
    flat = [f"{k} = {json.dumps(v)}" for k, v in tables.items() if v is not None and not isinstance(v, dict)]
    for name, table in tables.items():
        if isinstance(table, dict):
            flat += [f"[{name}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    (folder / "case.toml").write_text("\n".join(flat))


def whole_case(tmp_path: Path) -> Path:
    """Three images of a chest, a nodule and the case file that names them."""
    write_volume(tmp_path / IMAGES["ct"], chest(grid_at()))
    write_volume(tmp_path / IMAGES["cbct_inflated"], chest(grid_at((30.0, 0, 0), n=(14, 14, 12))))
    write_volume(tmp_path / IMAGES["cbct_deflated"], chest(grid_at((35.0, 5, 0), n=(14, 14, 12))))
    write_mask(tmp_path / "nodule.nii.gz", ball(grid_at()))
    write_toml(tmp_path)
    return tmp_path


def check_refused(folder: Path, error: type[VatslocError], sentence: str) -> None:
    with pytest.raises(error, match=sentence) as caught:
        read_case(folder)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(".")
