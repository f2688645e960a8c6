"""The scene for 3D Slicer: well-formed, every file and node it names is there, and everything lies where it should."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tests.vatsloc.test_results import result
from vatsloc.formats.markups import read_points
from vatsloc.formats.mrml import Frame, VolumeFile, write_scene
from vatsloc.results import NODULE_DEFLATED, SCENE, SCENE_WITH_SCANS, ResultData, write_results
from vatsloc.slicer_scene import write_result_scenes

IMAGES = {"ct": "the ct/slices", "cbct_inflated": "cbct inflated.nii.gz", "cbct_deflated": "cbct_50%.nii.gz"}


@pytest.fixture
def written(tmp_path: Path) -> tuple[Path, ResultData]:
    """A result beside a case whose CT is a folder of slices, and whose other files have odd names."""
    case, folder = tmp_path / "a case", tmp_path / "out" / "result"
    (case / IMAGES["ct"]).mkdir(parents=True)
    folder.mkdir(parents=True)
    for name in ("cbct_inflated", "cbct_deflated"):
        (case / IMAGES[name]).touch()
    lines = "\n".join(f'{name} = "{file}"' for name, file in IMAGES.items())
    (case / "case.toml").write_text(f'side = "right"\n[images]\n{lines}\n[nodule]\nmask = "n.nii.gz"\n')
    data = result()
    write_results(folder, data)
    write_result_scenes(folder, case, folder, data)
    return folder, data


def nodes(path: Path) -> dict[str, ET.Element]:
    """Nodes of a scene by id."""
    root = ET.parse(path).getroot()  # comments are left out by the parser
    assert root.tag == "MRML"
    found = {node.attrib["id"]: node for node in root}
    assert len(found) == len(list(root))
    return found


def referred(node: ET.Element) -> dict[str, str]:
    """Role -> id of what a node refers to."""
    return dict(re.findall(r"(\w+):([^;]+);", node.get("references", "")))


def to_world(scene: dict[str, ET.Element], node: ET.Element) -> np.ndarray:
    """The transforms above a node, RAS mm (4, 4), as Slicer concatenates them."""
    matrix = np.eye(4)
    while "transform" in referred(node):
        node = scene[referred(node)["transform"]]
        matrix = np.array(node.attrib["matrixTransformToParent"].split(), dtype=float).reshape(4, 4) @ matrix
    return matrix


def named(scene: dict[str, ET.Element], name: str) -> ET.Element:
    (found,) = (node for node in scene.values() if node.get("name") == name)
    return found


def named_files(path: Path) -> list[str]:
    return [unquote(node.attrib["fileName"]) for node in nodes(path).values() if "fileName" in node.attrib]


def test_every_file_is_there_relative_to_the_scene(written: tuple[Path, ResultData]) -> None:
    folder, _ = written
    files = named_files(folder / SCENE_WITH_SCANS)
    assert len(files) == 2 + 10  # of the case and of the result
    assert "../../a case/cbct_50%.nii.gz" in files
    for file in files:
        assert not Path(file).is_absolute()
        assert (folder / file).is_file(), file


def test_a_result_that_is_moved_alone_still_opens(written: tuple[Path, ResultData], tmp_path: Path) -> None:
    """The scene names files of the result alone, shows one of them, and says what it leaves out."""
    folder, _ = written
    moved = tmp_path / "elsewhere" / "deep" / "result"
    moved.parent.mkdir(parents=True)
    folder.rename(moved)
    files = named_files(moved / SCENE)
    assert len(files) == 10
    assert all((moved / file).is_file() and "/" not in file for file in files)
    scene = nodes(moved / SCENE)
    shown = scene["vtkMRMLSliceCompositeNodeRed"].attrib["backgroundVolumeID"]
    assert scene[shown].attrib["name"] == "CT warped to the deflated CBCT"
    text = (moved / SCENE).read_text(encoding="utf-8")
    assert "<!-- Left out, so that this folder can be moved: deflated CBCT (cbct_50%.nii.gz), inflated CBCT" in text


def test_every_node_referred_to_is_there_and_a_ct_of_slices_is_left_out(written: tuple[Path, ResultData]) -> None:
    scene = nodes(written[0] / SCENE_WITH_SCANS)
    for node in scene.values():
        for identity in referred(node).values():
            assert identity in scene
    for view in ("Red", "Yellow", "Green"):
        slices = scene[f"vtkMRMLSliceCompositeNode{view}"]
        assert scene[slices.attrib["backgroundVolumeID"]].attrib["name"] == "deflated CBCT"
        assert scene[slices.attrib["foregroundVolumeID"]].attrib["name"] == "CT warped to the deflated CBCT"
    assert not any(node.get("name") == "CT" for node in scene.values())
    assert {node.tag for node in scene.values()} >= {"Volume", "LabelMapVolume", "Model", "MarkupsFiducial"}


def test_the_inflated_scan_is_carried_to_the_deflated_one_in_ras(written: tuple[Path, ResultData]) -> None:
    folder, data = written
    scene = nodes(folder / SCENE_WITH_SCANS)
    assert_allclose(to_world(scene, named(scene, "inflated CBCT")), data.rigid_deflated_from_inflated, atol=1e-12)
    carried = to_world(scene, named(scene, "nodule, inflated")) @ [*data.nodule_inflated_ras, 1]
    expected = data.rigid_deflated_from_inflated @ [*data.nodule_inflated_ras, 1]
    assert_allclose(carried, expected, atol=1e-12)
    # What is of the deflated scan stays where its file puts it.
    assert_allclose(to_world(scene, named(scene, "nodule, deflated")), np.eye(4))
    assert_allclose(read_points(folder / NODULE_DEFLATED).ras[0], data.nodule_deflated_ras)


def test_of_the_surfaces_the_inflated_lung_alone_is_hidden(written: tuple[Path, ResultData]) -> None:
    scene = nodes(written[0] / SCENE)
    shown = {name: named(scene, f"{name} display") for name in ("deflated lung", "chest wall", "inflated lung")}
    seen = {name: (d.get("visibility"), d.get("visibility2D"), d.get("opacity")) for name, d in shown.items()}
    assert seen == {
        "deflated lung": ("true", "true", "0.4"),
        "chest wall": ("true", "true", "0.15"),
        "inflated lung": ("false", "false", "0.3"),
    }


def test_frames_are_concatenated_by_value_and_sign(tmp_path: Path) -> None:
    """A quarter turn about S after a shift to the right: (0, 0, 0) goes to (10, 0, 0) and then to (0, 10, 0)."""
    turn, shift = np.eye(4), np.eye(4)
    turn[:3, :3], shift[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [10, 0, 0]
    image = VolumeFile("image", tmp_path / "image.nii.gz", "inner")
    items = [Frame("outer", turn), Frame("inner", shift, "outer"), image]
    write_scene(tmp_path / SCENE, items, tmp_path, "image", "image")
    scene = nodes(tmp_path / SCENE)
    assert_allclose(to_world(scene, named(scene, "image")) @ [0, 0, 0, 1], [0, 10, 0, 1], atol=1e-12)


def test_fields_are_those_by_which_itk_resamples(written: tuple[Path, ResultData]) -> None:
    scene = nodes(written[0] / SCENE)
    for name, image in (("CT to inflated CBCT", "CBCTinflated"), ("CT to deflated CBCT", "CBCTdeflated")):
        storage = scene[referred(named(scene, name))["storage"]]
        assert storage.attrib["fileName"] == f"from-{image}_to-CT_mode-image_xfm.nii.gz"


def test_a_name_that_no_item_has_is_refused(tmp_path: Path) -> None:
    image = VolumeFile("image", tmp_path / "image.nii.gz")
    with pytest.raises(ValueError, match='"other" is no volume of the scene; it has image'):
        write_scene(tmp_path / SCENE, [image], tmp_path, "image", "other")
    items = [Frame("here", np.eye(4)), VolumeFile("image", tmp_path / "image.nii.gz", "nowhere")]
    with pytest.raises(ValueError, match='"nowhere" is no frame of the scene; it has here'):
        write_scene(tmp_path / SCENE, items, tmp_path, "image", "image")
