"""A case folder made from images that lie elsewhere: files linked or copied, case.toml written, what they show told."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array, Grid, Volume
from vatsloc.case import Case, read_case
from vatsloc.errors import CaseError, InputRefused, VatslocError
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import whole_folder
from vatsloc.formats.images import files_behind
from vatsloc.formats.markups import PointList, write_points
from vatsloc.imaging.greyvalues import peaks
from vatsloc.imaging.side import pleural_gas, seen_scans
from vatsloc.overlap import image_overlap

LONG_SUFFIXES = (".nii.gz", ".mrk.json", ".seg.nrrd")
POINT_SUFFIXES = (".mrk.json", ".json", ".fcsv")
POINT_FILE = "nodule_ct.mrk.json"


@dataclass(frozen=True)
class Sources:
    """Where the parts of a new case lie. nodule: a file, or its centre as (3,) RAS mm."""

    ct: Path
    cbct_inflated: Path | None
    cbct_deflated: Path
    nodule: Path | Array

    def images(self) -> dict[str, Path]:
        """The images by name, two or three."""
        given = {"ct": self.ct, "cbct_inflated": self.cbct_inflated, "cbct_deflated": self.cbct_deflated}
        return {name: path for name, path in given.items() if path is not None}


def nodule_source(text: str, lps: bool) -> Path | Array:
    """The file that `text` names, or the point X,Y,Z in mm that it is, in RAS. Raises CaseError where it is neither."""
    if text.strip() and Path(text).exists():
        if lps:
            raise CaseError("--lps is about a point X,Y,Z; a file states its own frame, so leave --lps out.")
        return Path(text)
    parts = text.split(",")
    try:
        point = np.array([float(part) for part in parts])
    except ValueError:
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise CaseError(
            f'--nodule "{text}" is neither a file that is there nor three numbers X,Y,Z in millimetres, with decimal '
            "points; give one of them."
        )
    return point * np.array([-1.0, -1.0, 1.0]) if lps else point


def new_case(folder: Path, sources: Sources, copy: bool = False) -> dict[str, Any]:
    """Write the case `folder`, whole or not at all, and return what its images show, for people and as JSON.

    Files are linked, or copied with `copy`. Raises CaseError where `folder` holds something or a path is not there, and
    the errors of `read_case`, which name the files given.
    """
    for path in [*sources.images().values(), *([sources.nodule] if isinstance(sources.nodule, Path) else [])]:
        if not path.exists():
            raise CaseError(f"{path} does not exist; correct the path.")
    with whole_folder(folder, (FILE_NAME,), lambda _: False) as partial:
        names = {name: _taken(path, partial, name, copy) for name, path in sources.images().items()}
        if isinstance(sources.nodule, Path):
            kind = "point" if sources.nodule.name.lower().endswith(POINT_SUFFIXES) else "mask"
            nodule = _taken(sources.nodule, partial, "nodule", copy)
        else:
            kind, nodule = "point", POINT_FILE
            write_points(partial / nodule, PointList(sources.nodule.reshape(1, 3), ("nodule",), ("",)))
        given = {**{names[key]: path for key, path in sources.images().items()}}
        if isinstance(sources.nodule, Path):
            given[nodule] = sources.nodule
        _write_case_file(partial, None, names, (kind, nodule))
        try:
            case = read_case(partial)
            told = _told(case)
        except VatslocError as error:
            raise type(error)(_in_given_words(str(error), partial, folder, given)) from error
        _write_case_file(partial, case, names, (kind, nodule))
    return {"case": str(folder), "files": "copied" if copy else "linked", **told}


def sentences(told: Mapping[str, Any]) -> str:
    """What `new_case` returned, in lines for people."""
    lines = [f"{told['case']}: files {told['files']}, {FILE_NAME} written"]
    for name, image in told["images"].items():
        air, tissue = image["air_hu"], image["tissue_hu"]
        hu = "air and soft tissue not told apart" if air is None else f"air {air:.0f} HU, soft tissue {tissue:.0f} HU"
        by = image["calibration"]
        made = "" if by is None else f" by HU = {by['slope']:.5g} x value {by['intercept']:+.1f}, for it is not in HU"
        size = " x ".join(map(str, image["voxels"]))
        voxel = " x ".join(f"{mm:.3g}" for mm in image["voxel_mm"])
        lines.append(f"{name}: {size} voxels of {voxel} mm, stored {image['axes']}, {hu}{made}")
    x, y, z = told["nodule_ras"]
    lines.append(f"nodule: {x:.1f} {y:.1f} {z:.1f} RAS mm, by {told['nodule_by']}")
    gas = told["pleural_gas"] or "not clear"
    lines.append(f"side: {told['side']}, told by the {told['told_by']} (pleural gas: {gas})")
    shares = ", ".join(f"{pair} {100 * share:.0f} %" for pair, share in told["overlap"].items())
    lines.append(f"overlap of the fields of view: {shares}")
    return "\n".join([*lines, *(f"warning: {sentence}" for sentence in told["warnings"])])


def _taken(source: Path, folder: Path, name: str, copy: bool) -> str:
    """Link or copy what `source` stands for into `folder` as `name`; returns the path that case.toml names.

    A header with its data in a second file goes with it into a folder of its own, for it knows that by name.
    """
    source = source.absolute()
    files = [source] if source.is_dir() else files_behind(source)
    if len(files) > 1:
        (folder / name).mkdir()
        for file in files:
            _put(file.absolute(), folder / name / file.name, copy)
        return f"{name}/{source.name}"
    long = next((suffix for suffix in LONG_SUFFIXES if source.name.lower().endswith(suffix)), None)
    target = name if source.is_dir() else name + (long or source.suffix.lower())
    _put(source, folder / target, copy)
    return target


def _put(source: Path, target: Path, copy: bool) -> None:
    if not copy:
        target.symlink_to(source.resolve(), target_is_directory=source.is_dir())
    elif source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copyfile(source, target)


def _write_case_file(folder: Path, case: Case | None, names: Mapping[str, str], nodule: tuple[str, str]) -> None:
    side = "" if case is None else f'side = "{case.side}"  # told by the {case.side_told_by}\n\n'
    images = "".join(f"{name} = {json.dumps(file, ensure_ascii=False)}\n" for name, file in names.items())
    kind, file = nodule
    text = f"{side}[images]\n{images}\n[nodule]\n{kind} = {json.dumps(file, ensure_ascii=False)}\n"
    (folder / FILE_NAME).write_text(text, encoding="utf-8")


def _told(case: Case) -> dict[str, Any]:
    images: dict[str, Volume] = {name: getattr(case, name) for name in case.scans}
    gas = pleural_gas(case.seen or seen_scans(case.cbct_inflated, case.cbct_deflated))
    gas.require(case.side, case.side_told_by)
    return {
        "images": {name: _image(case, name, image) for name, image in images.items()},
        "nodule_ras": [round(float(x), 2) for x in case.nodule.centre_ras],
        "nodule_by": "point" if case.nodule.mask is None else "mask",
        "side": case.side,
        "told_by": case.side_told_by,
        **gas.entry(),
        "overlap": _overlaps({name: image.grid for name, image in images.items()}),
        "warnings": list(case.warnings),
    }


def _image(case: Case, name: str, image: Volume) -> dict[str, Any]:
    air: float | None
    tissue: float | None
    try:
        air, tissue = (round(value, 1) for value in peaks(image))
    except InputRefused:
        air = tissue = None
    by = case.calibration.get(name)
    return {
        "voxels": list(image.hu.shape),
        "voxel_mm": [round(float(mm), 4) for mm in image.grid.spacing],
        "axes": case.stored_axes[name],
        "air_hu": air,
        "tissue_hu": tissue,
        "calibration": None if by is None else by.entry(),
    }


def _overlaps(grids: Mapping[str, Grid]) -> dict[str, float]:
    """Share of the smaller box of each pair inside the other."""
    return {f"{a} and {b}": round(image_overlap(grids[a], grids[b]), 3) for a, b in combinations(grids, 2)}


def _in_given_words(sentence: str, partial: Path, folder: Path, given: Mapping[str, Path]) -> str:
    """A sentence about the unfinished folder, about the files that were given."""
    for name, path in given.items():
        sentence = sentence.replace(str(partial / name), str(path))
    return sentence.replace(str(partial), str(folder))
