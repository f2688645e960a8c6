"""What the scene of a result shows in 3D Slicer: everything in the deflated CBCT's frame, as the spine places it."""

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
    ResultData,
)

INFLATED, CT = "inflated CBCT to deflated CBCT (spine)", "CT to inflated CBCT (spine)"
GREY = "#bec8d7"


def write_result_scene(path: Path, case: Path, folder: Path, data: ResultData) -> None:
    """Write the scene of a result that will lie in `folder`, beside the images of the case folder `case`.

    Images that are folders of DICOM slices are left out: a scene names files.
    """
    own = "CT warped to the deflated CBCT"
    images = _images(case)
    background = next((image.name for image in images if image.name == "deflated CBCT"), own)
    items: list[Item] = [
        Frame(INFLATED, data.rigid_deflated_from_inflated),
        Frame(CT, data.rigid_inflated_from_ct, INFLATED),
        *images,
        VolumeFile(own, folder / CT_IN_DEFLATED),
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
    write_scene(path, items, folder, background, own)


def _images(case: Path) -> list[VolumeFile]:
    files = read_case_file(case).images
    named = (
        ("deflated CBCT", files.cbct_deflated, None),
        ("inflated CBCT", files.cbct_inflated, INFLATED),
        ("CT", files.ct, CT),
    )
    return [VolumeFile(name, case / file, frame) for name, file, frame in named if (case / file).is_file()]
