"""The images of a case in HU: by what case.toml states, as they are, or by the peaks of air and soft tissue."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.volume import Volume
from vatsloc.errors import InputRefused
from vatsloc.formats.casefile import ImageFiles
from vatsloc.imaging.greyvalues import MAX_AIR_HU, Calibration, calibrate, calibrated, in_hu, may_be_hu

IMAGES = ("ct", "cbct_inflated", "cbct_deflated")


def stated_maps(files: ImageFiles) -> dict[str, Calibration]:
    """The maps that case.toml states, by image; a slope or an intercept left out is 1 or 0."""
    maps = {}
    for name in IMAGES:
        slope, intercept = getattr(files, f"{name}_slope"), getattr(files, f"{name}_intercept")
        if slope is not None or intercept is not None:
            maps[name] = Calibration(1.0 if slope is None else slope, 0.0 if intercept is None else intercept)
    return maps


def in_hounsfield(
    images: Mapping[str, Volume], paths: Mapping[str, Path], stated: Mapping[str, Calibration], warnings: list[str]
) -> tuple[dict[str, Volume], dict[str, Calibration]]:
    """Images by name in HU, and the maps of those that were not; what was found is said in `warnings`.

    Raises InputRefused that names the image where no map is stated and none can be found.
    """
    done, maps = {}, {}
    for name, image in images.items():
        if name in stated:
            maps[name] = stated[name]
            done[name] = _by_statement(name, image, stated[name], paths[name])
        elif in_hu(image) or (by := _found(name, image, paths[name])) is None:
            done[name] = image
        else:
            maps[name], done[name] = by, calibrated(image, by)
            warnings.append(
                f"{paths[name].name} is not in HU: its air reads {by.air:.4g} and its soft tissue {by.tissue:.4g}, "
                f"so HU = {by.slope:.5g} x value {by.intercept:+.1f} was taken."
            )
    return done, maps


def _by_statement(name: str, image: Volume, by: Calibration, path: Path) -> Volume:
    hu = calibrated(image, by)
    if not in_hu(hu):
        lowest = float(np.percentile(hu.hu[::4, ::4, ::4], 1))
        raise InputRefused(
            f"{path} is no chest image in HU under {name}_slope = {by.slope:g} and {name}_intercept = {by.intercept:g} "
            f"(its lowest percent starts at {lowest:.0f} HU, at most {MAX_AIR_HU:.0f} needed); correct them."
        )
    return hu


def _found(name: str, image: Volume, path: Path) -> Calibration | None:
    """The map by peaks; None where there are none, but the image can be HU."""
    try:
        found = calibrate(image)
    except InputRefused as why:
        if may_be_hu(image):
            return None
        lowest = float(np.percentile(image.hu[::4, ::4, ::4], 1))
        raise InputRefused(
            f"{path} shows no air in HU (its lowest percent starts at {lowest:.4g}) and cannot be calibrated: {why}; "
            f"export it with its rescale to HU, or state {name}_slope and {name}_intercept under [images] in case.toml."
        ) from why
    return replace(found, **{key: float(f"{value:.7g}") for key, value in found.entry().items() if value is not None})
