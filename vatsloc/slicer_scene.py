"""What the scenes of a result show in 3D Slicer: everything in the deflated CBCT's frame, as the spine places it."""

from __future__ import annotations

from pathlib import Path

from vatsloc.formats.casefile import read_case_file
from vatsloc.formats.mrml import FieldFile, Frame, Item, ModelFile, PointsFile, VolumeFile, write_scene
from vatsloc.report.data import LUNG, NODULE, SURFACE
from vatsloc.results import (
    CONTACT_STL,
    CT_FROM_DEFLATED,
    CT_FROM_INFLATED,
    CT_IN_DEFLATED,
    CT_IN_INFLATED,
    DEFLATED_STL,
    LUNG_INFLATED,
    NODULE_DEFLATED,
    NODULE_INFLATED,
    NODULE_MASK,
    SCENE,
    SCENE_WITH_SCANS,
    ResultData,
)

INFLATED, CT = "inflated CBCT to deflated CBCT (spine)", "CT to inflated CBCT (spine)"
GREY = "#bec8d7"


def write_result_scenes(partial: Path, case: Path, folder: Path, data: ResultData) -> None:
    """Write both scenes of a result that is filled as `partial` and will lie in `folder`, of the case folder `case`.

    SCENE names files of the result alone, so that the folder can be moved; SCENE_WITH_SCANS shows the case's images
    too, where they lie now. Images that are folders of DICOM slices are left out: a scene names files.
    """
    images = _images(case)
    own = _own(folder, data)
    warped = "CT warped to the deflated CBCT"
    left_out = ", ".join(f"{image.name} ({image.path.name})" for image in images) or "no scan is a file"
    note = f"Left out, so that this folder can be moved: {left_out}; {SCENE_WITH_SCANS} shows the scans where they lay."
    write_scene(partial / SCENE, own, folder, warped, warped, note)
    background = next((image.name for image in images if image.name == "deflated CBCT"), warped)
    write_scene(partial / SCENE_WITH_SCANS, [*own, *images], folder, background, warped)


def _own(folder: Path, data: ResultData) -> list[Item]:
    """What lies in the result itself."""
    return [
        Frame(INFLATED, data.rigid_deflated_from_inflated),
        Frame(CT, data.rigid_inflated_from_ct, INFLATED),
        VolumeFile("CT warped to the deflated CBCT", folder / CT_IN_DEFLATED),
        VolumeFile("CT warped to the inflated CBCT", folder / CT_IN_INFLATED, INFLATED),
        VolumeFile("nodule", folder / NODULE_MASK, label=True),
        ModelFile("deflated lung", folder / DEFLATED_STL, LUNG, 0.4),
        ModelFile("chest wall", folder / CONTACT_STL, GREY, 0.15),
        ModelFile("inflated lung", folder / LUNG_INFLATED, SURFACE, 0.3, visible=False, frame=INFLATED),
        PointsFile("nodule, deflated", folder / NODULE_DEFLATED, NODULE),
        PointsFile("nodule, inflated", folder / NODULE_INFLATED, SURFACE, INFLATED),
        FieldFile("CT to inflated CBCT", folder / CT_FROM_INFLATED),
        FieldFile("CT to deflated CBCT", folder / CT_FROM_DEFLATED),
    ]


def _images(case: Path) -> list[VolumeFile]:
    files = read_case_file(case).images
    named = (
        ("deflated CBCT", files.cbct_deflated, None),
        ("inflated CBCT", files.cbct_inflated, INFLATED),
        ("CT", files.ct, CT),
    )
    return [VolumeFile(name, case / file, frame) for name, file, frame in named if file and (case / file).is_file()]
