"""A case in memory: its images, the nodule, the side and the setup, checked as far as headers and voxels allow.

All images leave this module with voxel axes in one order (LPS, as axial DICOM slices are stored), so that later stages
need no thought about storage; `Case.stored_axes` remembers the order of the files, for writing results on their grids.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array, Grid, Mask, Volume, axis_codes
from vatsloc.calibration import in_hounsfield, stated_maps
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.casefile import FILE_NAME, CaseFile, PleuralGas, SeriesName, Side, Triple, read_case_file
from vatsloc.formats.dicom.regions import holds_regions
from vatsloc.formats.guard import reading
from vatsloc.formats.images import files_behind, read_volume_and_warnings, stated_frame
from vatsloc.formats.markups import PointList, read_points
from vatsloc.formats.meshes import Surface
from vatsloc.frames import reorient
from vatsloc.imaging.greyvalues import Calibration
from vatsloc.imaging.side import SeenScans, ToldSide, nodule_side, told_side
from vatsloc.marks import AXES, Nodule, NoduleSource, mask_on, one_point, read_hint_surface, read_nodule
from vatsloc.overlap import check_overlap, inside_of

IMAGES = ("ct", "cbct_inflated", "cbct_deflated")
IMAGE_MM = (60.0, 3000.0)
"""Between these lies the longest side of any image of a chest, not of one in metres or micrometres."""


@dataclass(frozen=True)
class Hints:
    """Optional help by hand, None where absent. Points (3,) RAS mm; lung_mask_ct: on the CT's grid."""

    spine_ct_ras: Array | None = None
    spine_cbct_inflated_ras: Array | None = None
    lung_mask_ct: Mask | None = None
    deflated_surface: Surface | None = None


@dataclass(frozen=True)
class CaseBefore:
    """What is known of a case before its lung is collapsed.

    side: of the operated lung; cbct_inflated: None where it was not taken, or not yet; gravity_ras: unit (3,) in the
    CBCT's frame; input_sha256 and stored_axes: by name of the input; warnings: sentences for the report; calibration:
    what made images HU, by name of those that were not; side_told_by: "case.toml", "nodule" or "pleural gas";
    seen: the cone-beam CTs as prepared, where gas told it.
    """

    folder: Path
    side: Side
    ct: Volume
    cbct_inflated: Volume | None
    nodule: Nodule
    gravity_ras: Array
    pleural_gas: PleuralGas
    hints: Hints
    input_sha256: Mapping[str, str]
    stored_axes: Mapping[str, str]
    warnings: tuple[str, ...] = ()
    calibration: Mapping[str, Calibration] = field(default_factory=dict)
    side_told_by: str = FILE_NAME
    seen: SeenScans | None = None


@dataclass(frozen=True, kw_only=True)
class Case(CaseBefore):
    """Everything `localize` may know."""

    cbct_deflated: Volume

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the images that it has."""
        return tuple(name for name in IMAGES if getattr(self, name) is not None)


@dataclass(frozen=True)
class Landmarks:
    """What only `evaluate` may know, None where absent: landmarks by image, true nodule centres (3,) RAS mm."""

    ct: PointList | None
    cbct_inflated: PointList | None
    cbct_deflated: PointList | None
    nodule_inflated_ras: Array | None
    nodule_deflated_ras: Array | None


def read_case(folder: Path) -> Case:
    """The case of a folder, without its landmarks and its truth.

    Raises CaseError for a wrong case file, InputRefused for inputs that cannot be trusted or do not belong together.
    """
    file = read_case_file(folder)
    read = _read(folder, file, tuple(name for name in IMAGES if name != "cbct_inflated" or file.images.cbct_inflated))
    images, inflated = read.images, read.images.get("cbct_inflated")
    deflated, nodule = images["cbct_deflated"], read.nodule
    told = read.side or told_side(images["ct"], nodule.mask, nodule.centre_ras, inflated, deflated)
    return Case(**_known(read, told), cbct_inflated=inflated, cbct_deflated=deflated)


def read_case_before(folder: Path, wanted: tuple[str, ...] = ("ct", "cbct_inflated")) -> CaseBefore:
    """What there is of a case before the lung is collapsed: the CT, and the inflated scan once its file is there.

    wanted: of these the ones to read. Raises as `read_case`, and InputRefused where neither case.toml nor the nodule
    tells the side.
    """
    file = read_case_file(folder)
    inflated = file.images.cbct_inflated
    there = ("ct",) if inflated is None or not (folder / inflated).exists() else ("ct", "cbct_inflated")
    taken = tuple(name for name in wanted if name in there)
    read = _read(folder, file, taken)
    side = read.side or nodule_side(read.images["ct"], read.nodule.mask, read.nodule.centre_ras)
    if side is None:
        raise InputRefused(
            "The nodule's place in the CT does not tell the operated side, and no deflated CBCT is there to tell it; "
            'add side = "right" or side = "left" to case.toml.'
        )
    told = side if isinstance(side, ToldSide) else ToldSide(side, "nodule")
    return CaseBefore(**_known(read, told), cbct_inflated=read.images.get("cbct_inflated"))


@dataclass(frozen=True)
class _Read:
    """Images of a folder by name, in HU, and what belongs to them. side: as case.toml states it."""

    folder: Path
    file: CaseFile
    images: dict[str, Volume]
    axes: dict[str, str]
    nodule: Nodule
    side: ToldSide | None
    hints: Hints
    sha256: dict[str, str]
    warnings: list[str]
    calibration: dict[str, Calibration]


def _read(folder: Path, file: CaseFile, taken: tuple[str, ...]) -> _Read:
    """Read and check the images `taken`, and the nodule."""
    paths = _input_paths(folder, file, taken)
    with ThreadPoolExecutor(max_workers=2) as pool:  # decompression and hashing release the interpreter lock
        found = pool.map(lambda name: _read_image(paths[name], file.images.series(name)), taken)
        digests = pool.map(sha256, paths.values())
        volumes, axes, said = zip(*found, strict=True)
        input_sha256 = dict(zip(paths, digests, strict=True))
    grids = {name: volume.grid for name, volume in zip(taken, volumes, strict=True)}
    for number, a in enumerate(taken):
        for b in taken[number + 1 :]:
            check_overlap(grids[a], grids[b], paths[a], paths[b])
    warnings = [sentence for sentences in said for sentence in sentences]
    named = dict(zip(taken, volumes, strict=True))
    images, calibration = in_hounsfield(named, paths, stated_maps(file.images), warnings)
    frame = _frame_of_ct(paths, file)
    source = NoduleSource(paths.get("nodule_mask"), file.nodule.label, paths.get("nodule_point"), frame)
    return _Read(
        folder=folder,
        file=file,
        images=images,
        axes=dict(zip(taken, axes, strict=True)),
        nodule=read_nodule(source, grids["ct"], warnings),
        side=ToldSide(file.side, FILE_NAME) if file.side else None,
        hints=_hints(file, paths, grids, frame, warnings),
        sha256=input_sha256,
        warnings=warnings,
        calibration=calibration,
    )


def _known(read: _Read, told: ToldSide) -> dict[str, Any]:
    """Fields that every case has."""
    return {
        "folder": read.folder,
        "side": told.side,
        "ct": read.images["ct"],
        "nodule": read.nodule,
        "gravity_ras": _gravity(told.side, read.file.setup.gravity_cbct),
        "pleural_gas": read.file.setup.pleural_gas,
        "hints": read.hints,
        "input_sha256": read.sha256,
        "stored_axes": read.axes,
        "warnings": tuple(read.warnings),
        "calibration": read.calibration,
        "side_told_by": told.by,
        "seen": told.seen,
    }


def read_landmarks(folder: Path) -> Landmarks:
    """Landmarks and true nodule positions, by case.toml or else by their usual names; absent ones are None.

    Raises CaseError when a file that case.toml names is not there, InputRefused when one cannot be trusted.
    """
    named = read_case_file(folder).landmarks
    lists = {
        image: _points_or_none(folder, getattr(named, image), f"landmarks_{image}.mrk.json")
        for image in ("ct", "cbct_inflated", "cbct_deflated")
    }
    truth = {image: folder / "truth" / f"nodule_{image}.mrk.json" for image in ("cbct_inflated", "cbct_deflated")}
    nodule = {image: one_point(path) if path.exists() else None for image, path in truth.items()}
    return Landmarks(**lists, nodule_inflated_ras=nodule["cbct_inflated"], nodule_deflated_ras=nodule["cbct_deflated"])


def sha256(path: Path) -> str:
    """Digest of a file, or of the digests of all files that an image path stands for."""
    digests = []
    for file in files_behind(path):
        with reading(file, "file"), file.open("rb") as stream:
            digests.append(hashlib.file_digest(stream, "sha256").hexdigest())
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


def _input_paths(folder: Path, file: CaseFile, taken: tuple[str, ...]) -> dict[str, Path]:
    """Files of the images `taken` and of what goes with them, by name."""
    names = {name: getattr(file.images, name) for name in taken}
    for name in taken:
        if names[name] is None:
            raise CaseError(f"{folder / FILE_NAME}: [images] {name} is missing; add it.")
    names |= {
        "nodule_mask": file.nodule.mask,
        "nodule_point": file.nodule.point,
        "lung_mask_ct": file.hints.lung_mask_ct,
        "deflated_surface": file.hints.deflated_surface if "cbct_deflated" in taken else None,
    }
    paths = {key: folder / name for key, name in names.items() if name is not None}
    for key, path in paths.items():
        with reading(path, "file", "correct case.toml", CaseError):
            there = path.exists()
        if not there:
            raise CaseError(f"{path} ({key} in case.toml) does not exist; put it there or correct case.toml.")
    return paths


def _gravity(side: Side, stated: Triple | None) -> Array:
    """Unit vector in RAS; by default from the operated side, which lies up, to the other one."""
    default = np.array([-1.0, 0.0, 0.0]) if side == "right" else np.array([1.0, 0.0, 0.0])
    if stated is None:
        return default
    gravity = np.array(stated) / np.linalg.norm(stated)
    if gravity @ default < -0.5:
        raise CaseError(
            f"gravity_cbct = {list(stated)} points to the {side} side, but the operated {side} lung lies up; "
            "correct side or the sign of gravity_cbct in case.toml."
        )
    return gravity


def _frame_of_ct(paths: Mapping[str, Path], file: CaseFile) -> str:
    """Frame of reference of a DICOM CT, where a region drawn in DICOM has to be compared with it; else ""."""
    drawn = any(key in paths and holds_regions(paths[key]) for key in ("nodule_mask", "lung_mask_ct"))
    return stated_frame(paths["ct"], file.images.ct_series) if drawn else ""


def _read_image(path: Path, series: SeriesName | None) -> tuple[Volume, str, tuple[str, ...]]:
    """The image, the order of its axes as stored, and warnings of its reader."""
    volume, warnings = read_volume_and_warnings(path, series)
    size = np.array(volume.hu.shape) * volume.grid.spacing
    if not IMAGE_MM[0] <= size.max() <= IMAGE_MM[1]:
        raise InputRefused(
            f"{path} measures {' x '.join(f'{mm:.3g}' for mm in size)} mm, which no image of a chest does; "
            "export it with its voxel size in millimetres."
        )
    hu, ras_from_ijk = reorient(volume.hu, volume.ras_from_ijk, AXES)
    return Volume(np.ascontiguousarray(hu), ras_from_ijk), axis_codes(volume.ras_from_ijk), warnings


def _hints(
    file: CaseFile, paths: Mapping[str, Path], grids: Mapping[str, Grid], frame: str, warnings: list[str]
) -> Hints:
    spines: list[Array | None] = []
    for key, point, image in (
        ("spine_ct", file.hints.spine_ct, "ct"),
        ("spine_cbct_inflated", file.hints.spine_cbct_inflated, "cbct_inflated"),
    ):
        if point is not None and image in grids and not inside_of(grids[image], np.array(point)):
            raise CaseError(
                f"{key} = {list(point)} in case.toml lies outside its image; give RAS millimetres inside it."
            )
        spines.append(None if point is None else np.array(point))
    lung = surface = None
    if "lung_mask_ct" in paths:
        ask = "[hints] lung_label = ... in case.toml"
        lung = mask_on(paths["lung_mask_ct"], grids["ct"], file.hints.lung_label, ask, warnings, frame)
    if "deflated_surface" in paths:
        surface = read_hint_surface(paths["deflated_surface"], grids["cbct_deflated"], warnings)
    return Hints(spines[0], spines[1], lung, surface)


def _points_or_none(folder: Path, named: str | None, usual: str) -> PointList | None:
    if named is not None:
        return read_points(folder / named)
    return read_points(folder / usual) if (folder / usual).exists() else None
