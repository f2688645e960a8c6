"""A breathing case: the files of its folder, by `breath.toml` or by their usual names. Landmarks are not read."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from registration.volume import Array, Mask, Volume
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import reading
from vatsloc.formats.images import read_mask, read_volume

FILE_NAME = "breath.toml"
USUAL = (
    ("lungs_inspiration.nii.gz", "lungs_expiration.nii.gz", "ct_inspiration.nii.gz", "ct_expiration.nii.gz"),
    ("right_lung_first.nii.gz", "right_lung_second.nii.gz", "chest_first.nii.gz", "chest_second.nii.gz"),
    ("left_lung_first.nii.gz", "left_lung_second.nii.gz", "chest_first.nii.gz", "chest_second.nii.gz"),
)
"""Masks and images of folders without `breath.toml`: inspiration, expiration."""
LANDMARKS = "landmarks_ras_mm.csv"


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Pair(_Table):
    """A file for either state."""

    inspiration: str | None = None
    expiration: str | None = None


class One(_Table):
    """A single file."""

    file: str | None = None


class Signal(_Table):
    """file: t_s, volume; hysteresis: how much the diaphragm leads on the way in, 0 for none to 1."""

    file: str | None = None
    hysteresis: float = Field(default=0.0, ge=0, le=1)


class Tumour(_Table):
    """A ball put into the image of the scan, for driver one-scan. centre: RAS mm."""

    centre: tuple[float, float, float]
    radius_mm: float = Field(default=10.0, gt=0, le=60)


class BreathFile(_Table):
    """The whole of breath.toml; every key may be left out, but not all images and masks."""

    images: Pair = Pair()
    masks: Pair = Pair()
    signal: Signal = Signal()
    landmarks: One = One()
    tumour: Tumour | None = None


@dataclass(frozen=True)
class Scan:
    """What is known of one state: an image, a mask of the lungs, or both."""

    name: str
    image: Volume | None
    mask: Mask | None


@dataclass(frozen=True)
class BreathCase:
    """Scans of a folder; expiration None where there is but one; signal (k, 2): seconds and volume 0..1, or None;
    masks_alone: two images, where there are, are not registered.
    """

    name: str
    folder: Path
    inspiration: Scan | None
    expiration: Scan | None
    signal: Array | None
    landmarks: Path | None
    hysteresis: float = 0.0
    tumour: Tumour | None = None
    masks_alone: bool = False

    @property
    def images(self) -> tuple[Volume, Volume] | None:
        """Inspired and expired image to be registered; None where there are not both, or masks alone are asked for."""
        if self.masks_alone or self.inspiration is None or self.expiration is None:
            return None
        full, rest = self.inspiration.image, self.expiration.image
        return None if full is None or rest is None else (full, rest)


def read_breath(folder: Path) -> BreathCase:
    """The case of a folder. Raises CaseError for a wrong breath.toml or missing files, InputRefused for bad images."""
    file = _file(folder)
    scans = {state: _scan(folder, file, state) for state in ("inspiration", "expiration")}
    if scans["inspiration"] is None and scans["expiration"] is None:
        raise CaseError(
            f"{folder} names no image and no mask; write a {FILE_NAME} with [images] or [masks], "
            f"or give {USUAL[0][0]} and {USUAL[0][1]}."
        )
    return BreathCase(
        folder.resolve().name,
        folder,
        scans["inspiration"],
        scans["expiration"],
        None if file.signal.file is None else read_signal(folder / file.signal.file),
        None if file.landmarks.file is None else folder / file.landmarks.file,
        file.signal.hysteresis,
        file.tumour,
    )


def read_signal(path: Path) -> Array:
    """Seconds and volumes (k, 2), 0 at expiration to 1 at inspiration, of a CSV with columns t_s, volume."""
    rows = read_rows(path, 2, "t_s,volume")
    if len(rows) < 2 or not (np.diff(rows[:, 0]) > 0).all() or rows[:, 1].min() < 0 or rows[:, 1].max() > 1:
        raise InputRefused(f"{path} needs two or more rows, times that rise and volumes from 0 to 1; write t_s,volume.")
    return rows


def read_rows(path: Path, columns: int, head: str) -> Array:
    """Numbers (k, columns) of a CSV file below its header line."""
    if not path.is_file():
        raise CaseError(f"{path} does not exist; correct {FILE_NAME} or put the file there.")
    with reading(path, "table of numbers", f"write {columns} numbers per line"):
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    try:
        rows = np.array([[float(value) for value in line.split(",")] for line in lines[1:]])
    except ValueError as error:
        raise InputRefused(f"{path} has no numbers, or rows of unlike length ({error}); write {head}.") from error
    if rows.ndim != 2 or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise InputRefused(f"{path} has rows that are not {columns} finite numbers; write {head}.")
    return rows


def _file(folder: Path) -> BreathFile:
    if not folder.is_dir():
        raise CaseError(f"{folder} is no folder; give one that holds {FILE_NAME}, or masks and landmarks.")
    path = folder / FILE_NAME
    if not path.is_file():
        return _usual(folder)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return BreathFile.model_validate(table)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaseError(f"{path} is not valid TOML ({error}); correct it.") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise CaseError(f"{path}: {key} is wrong ({first['msg'].lower()}); correct or remove it.") from error


def _usual(folder: Path) -> BreathFile:
    def there(name: str) -> str | None:
        return name if (folder / name).exists() else None

    for mask_in, mask_ex, image_in, image_ex in USUAL:
        masks, images = (
            Pair(inspiration=there(mask_in), expiration=there(mask_ex)),
            Pair(inspiration=there(image_in), expiration=there(image_ex)),
        )
        if masks.inspiration or masks.expiration:
            return BreathFile(images=images, masks=masks, landmarks=One(file=there(LANDMARKS)))
    raise CaseError(
        f"{folder} holds no {FILE_NAME}, nor {USUAL[0][0]} and {USUAL[0][1]}; write a {FILE_NAME} that names the files."
    )


def _scan(folder: Path, file: BreathFile, state: str) -> Scan | None:
    image, mask = getattr(file.images, state), getattr(file.masks, state)
    if image is None and mask is None:
        return None
    return Scan(
        state,
        None if image is None else read_volume(folder / image),
        None if mask is None else read_mask(folder / mask),
    )
