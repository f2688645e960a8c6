"""Synthetic cases as case folders: images, landmarks and truth in the files that every case has."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from phantoms.case import PhantomCase, make_case
from phantoms.recipes import SPECS
from phantoms.spec import PhantomSpec
from phantoms.twin import Scan, make_twin
from registration.volume import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.casefile import FILE_NAME
from vatsloc.formats.folder import whole_folder
from vatsloc.formats.images import read_region, read_volume
from vatsloc.formats.markups import PointList, write_points
from vatsloc.formats.nifti import write_mask, write_volume
from vatsloc.imaging.hilum import find_hilum
from vatsloc.imaging.lungs import Side, segment_lungs
from vatsloc.imaging.spine import segment_spine
from vatsloc.synthetic.voxels import to_image, to_mask, to_region, to_volume
from vatsloc.workflow.stages import Say, Stages, quiet

INFO_FILE = "truth/info.json"
DENSE_HEADER = "ct_x,ct_y,ct_z,inf_x,inf_y,inf_z,def_x,def_y,def_z"


def write_phantom(name: str, folder: Path, seed: int = 0, say: Say = quiet, cbct: str | None = None) -> None:
    """Make the phantom called `name` and write it as a case folder, whole or not at all.

    cbct: domain of the scanner, "image" or "projection", default that of the recipe. Raises CaseError for an unknown
    name or domain, or where `folder` holds something else.
    """
    if name not in SPECS:
        raise CaseError(f'"{name}" is no phantom; choose one of {", ".join(SPECS)}.')
    spec = scanned(SPECS[name], cbct)
    say(f"phantom {name}, seed {seed} ...")
    _write_whole(lambda: make_case(spec, seed), folder, recipe(name, seed, cbct), say)


def scanned(spec: PhantomSpec, cbct: str | None) -> PhantomSpec:
    """The phantom with its scanner in a domain, None for that of its recipe; raises CaseError for an unknown one."""
    if cbct is None:
        return spec
    if cbct not in ("image", "projection"):
        raise CaseError(f'--cbct must be image or projection, got "{cbct}".')
    return replace(spec, scanner=replace(spec.scanner, domain=cbct))


def write_twin(
    ct: Path,
    side: Side,
    folder: Path,
    name: str | None = None,
    seed: int = 0,
    nodule: Path | None = None,
    say: Say = quiet,
    cbct: str | None = None,
) -> None:
    """Make the digital twin of one scan and write it as a case folder, whole or not at all.

    ct: image or DICOM folder; name: phantom whose collapse, lesion and scanner it gets; nodule: mask of the one it has,
    else one is put in; cbct: as in `write_phantom`. Raises CaseError for an unknown name, InputRefused where the scan
    does not show what is needed.
    """
    spec = scanned(twin_spec(side, name), cbct)
    say(f"twin of {ct.name}, {side} lung, seed {seed} ...")
    scan = read_scan(ct, side, nodule)
    made_from = {"spec": json.loads(json.dumps(asdict(spec))), "seed": seed, "scan": ct.name}
    _write_whole(lambda: _twin_or_refusal(ct, scan, spec, seed), folder, made_from, say)


def _twin_or_refusal(ct: Path, scan: Scan, spec: PhantomSpec, seed: int) -> PhantomCase:
    """The twin of a scan; raises InputRefused where the scan does not show what is needed."""
    try:
        return make_twin(scan, spec, seed)
    except ValueError as refusal:
        more = "" if scan.nodule is not None else ", or give the mask of a nodule that it has by --nodule"
        raise InputRefused(f"{ct}: {refusal}{more}.") from refusal


def side_named(side: str) -> Side:
    """The side called so; raises CaseError for another word."""
    sides: dict[str, Side] = {"right": "right", "left": "left"}
    if side not in sides:
        raise CaseError(f'--side must be right or left, got "{side}".')
    return sides[side]


def twin_spec(side: Side, name: str | None) -> PhantomSpec:
    """What a twin is made like: the phantom called `name`, on `side`. Raises CaseError for an unknown name."""
    if name is not None and name not in SPECS:
        raise CaseError(f'"{name}" is no phantom; choose one of {", ".join(SPECS)}.')
    like = PhantomSpec("twin", side) if name is None else SPECS[name]
    return replace(like, name="twin", side=side, fused=1.0)


def read_scan(ct: Path, side: Side, nodule: Path | None = None) -> Scan:
    """A chest CT with its lungs, spine and the root of the lung on `side`; raises InputRefused where it lacks one."""
    image = read_volume(ct)
    given = None if nodule is None else read_region(nodule, ask="save the nodule alone")
    lungs = segment_lungs(image, side, given)
    hilum = find_hilum(lungs.of(side), lungs.airways, side)
    regions = {"right": to_region(lungs.right), "left": to_region(lungs.left)}
    own = None if given is None else to_region(given)
    return Scan(to_image(image), regions, segment_spine(image).centres_ras, hilum.point_ras, own)


def _write_whole(make: Callable[[], PhantomCase], folder: Path, made_from: dict[str, Any], say: Say) -> None:
    log = Stages()
    with whole_folder(folder, (FILE_NAME, INFO_FILE), _is_phantom) as partial:
        with log.stage("phantom"):
            made = make()
            _write(made, partial)
        cost = {"seconds": log.seconds["phantom"], "peak_mb": log.peak_mb["phantom"]}
        info = made_from | cost | made.info
        (partial / INFO_FILE).write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
    say(f"{made.spec.name} written to {folder}: {cost['seconds']:.0f} s, {cost['peak_mb']:.0f} MB")


def recipe(name: str, seed: int, cbct: str | None = None) -> dict[str, Any]:
    """What a phantom is made from, as its truth/info.json says it."""
    return {"spec": json.loads(json.dumps(asdict(scanned(SPECS[name], cbct)))), "seed": seed}


def read_info(folder: Path) -> dict[str, Any] | None:
    """truth/info.json of the phantom in `folder`; None where there is none."""
    if not (folder / FILE_NAME).is_file() or not (folder / INFO_FILE).is_file():
        return None
    return dict(json.loads((folder / INFO_FILE).read_text(encoding="utf-8")))


def _is_phantom(folder: Path) -> bool:
    return (folder / INFO_FILE).is_file() and (folder / FILE_NAME).read_text(encoding="utf-8").startswith("# phantom")


def _write(phantom: PhantomCase, folder: Path) -> None:
    truth = folder / "truth"
    truth.mkdir()
    write_volume(folder / "ct.nii.gz", to_volume(phantom.ct))
    write_volume(folder / "cbct_inflated.nii.gz", to_volume(phantom.cbct_inflated))
    write_volume(folder / "cbct_deflated.nii.gz", to_volume(phantom.cbct_deflated))
    write_mask(folder / "nodule.nii.gz", to_mask(phantom.nodule))
    write_points(folder / "nodule_ct.mrk.json", _nodule(phantom.nodule_ct))
    write_points(truth / "nodule_cbct_inflated.mrk.json", _nodule(phantom.nodule_inflated))
    write_points(truth / "nodule_cbct_deflated.mrk.json", _nodule(phantom.nodule_deflated))
    for image, points in (
        ("ct", phantom.landmarks_ct),
        ("cbct_inflated", phantom.landmarks_inflated),
        ("cbct_deflated", phantom.landmarks_deflated),
    ):
        labels = tuple(f"{n + 1}" for n in range(len(points)))
        write_points(folder / f"landmarks_{image}.mrk.json", PointList(points, labels, ("",) * len(points)))
    for name, region in phantom.masks.items():
        write_mask(truth / f"{name}.nii.gz", to_mask(region))
    np.savetxt(
        truth / "dense_ras_mm.csv", phantom.dense_truth, fmt="%.3f", delimiter=",", header=DENSE_HEADER, comments=""
    )
    (folder / FILE_NAME).write_text(_case_file(phantom), encoding="utf-8")


def _nodule(point: Array) -> PointList:
    return PointList(np.reshape(point, (1, 3)), ("nodule",), ("",))


def _case_file(phantom: PhantomCase) -> str:
    gravity = ", ".join(f"{g:.4f}" for g in phantom.gravity_cbct)
    return f"""# phantom {phantom.spec.name}, seed {phantom.seed}
side = "{phantom.side}"

[images]
ct = "ct.nii.gz"
cbct_inflated = "cbct_inflated.nii.gz"
cbct_deflated = "cbct_deflated.nii.gz"

[nodule]
mask = "nodule.nii.gz"

[setup]
gravity_cbct = [{gravity}]
pleural_gas = "{phantom.spec.collapse.gas}"

[landmarks]
ct = "landmarks_ct.mrk.json"
cbct_inflated = "landmarks_cbct_inflated.mrk.json"
cbct_deflated = "landmarks_cbct_deflated.mrk.json"
"""
