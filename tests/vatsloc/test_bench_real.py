"""Benchmark on real lungs: what its folders must hold, its yardsticks by value, and scores of a known motion."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from numpy.testing import assert_allclose

from poro.mesh.tetmesh import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.study import bench_real as bench
from vatsloc.study.affine import affine_to_points, affine_to_shape
from vatsloc.study.breaths import read_person
from vatsloc.study.poro_lung import lung, wall_level

CENTRES = {"left": np.array([-65.0, 0.0, 0.0]), "right": np.array([65.0, 0.0, 0.0])}
SQUEEZE = np.diag([0.9, 0.85, 0.88])
SHIFT = np.array([0.0, -8.0, 5.0])


def squeeze(points: Array, centre: Array) -> Array:
    return (points - centre) @ SQUEEZE.T + centre + SHIFT


def write_person(folder: Path) -> Path:
    """Two mirrored lungs squeezed by a known map, with 40 landmarks in each."""
    spacing = 3.0
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = [-126.0, -81.0, -120.0]
    shape = (85, 55, 81)
    grid = np.stack(np.meshgrid(*(np.arange(n) * spacing for n in shape), indexing="ij"), -1) + affine[:3, 3]
    random = np.random.default_rng(3)
    rows = []
    masks = {"inspiration": np.zeros(shape, bool), "expiration": np.zeros(shape, bool)}
    for side, centre in CENTRES.items():
        mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
        masks["inspiration"] |= wall_level((grid - centre) * mirror) > 0
        back = (grid - centre - SHIFT) @ np.linalg.inv(SQUEEZE).T
        masks["expiration"] |= wall_level(back * mirror) > 0
        inside = random.uniform([-40, -55, -80], [40, 55, 80], (400, 3))
        marks = inside[wall_level(inside * mirror) > 5][:40] + centre
        rows.append(np.hstack([marks, squeeze(marks, centre)]))
    folder.mkdir()
    for name, mask in masks.items():
        nib.save(nib.Nifti1Image(mask.astype(np.uint8), affine), folder / f"lungs_{name}.nii.gz")
    np.savetxt(
        folder / "landmarks_ras_mm.csv",
        np.concatenate(rows),
        delimiter=",",
        header="insp_x,insp_y,insp_z,exp_x,exp_y,exp_z",
        comments="",
    )
    return folder


@pytest.fixture(scope="module")
def person_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_person(tmp_path_factory.mktemp("real") / "squeezed")


def test_affine_map_of_points_is_exact() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    found = affine_to_points(points, points @ SQUEEZE.T + SHIFT)
    assert_allclose(found.matrix, SQUEEZE, atol=1e-12)
    assert_allclose(found.shift, SHIFT, atol=1e-12)


def test_affine_map_of_a_shape_is_found_without_matches() -> None:
    surface = lung(6_000).mesh.boundary
    other = lung(9_000).mesh.boundary
    turn = np.array([[1, -0.08, 0.03], [0.08, 1, 0.05], [-0.03, -0.05, 1]]) @ SQUEEZE
    found = affine_to_shape(surface, other.moved(other.points @ turn.T + SHIFT))
    assert_allclose(found.matrix, turn, atol=0.01)
    assert_allclose(found.shift, SHIFT, atol=0.5)


def test_scores_of_a_known_motion(person_folder: Path) -> None:
    result = bench.bench_real([person_folder])
    assert [case["direction"] for case in result["cases"]] == ["inspiration to expiration", "expiration to inspiration"]
    for case in result["cases"]:
        rows = case["rows"]
        assert {lung: row["n"] for lung, row in rows[bench.UNMOVED].items()} == {"left": 40, "right": 40, "both": 80}
        assert rows[bench.TRUE_AFFINE]["both"]["max"] < 1e-9
        assert rows[bench.SHAPE_AFFINE]["both"]["mean"] < 1.0
        assert rows[bench.ELASTIC]["both"]["mean"] < 1.5
    marks = np.loadtxt(person_folder / "landmarks_ras_mm.csv", delimiter=",", skiprows=1)
    moved = np.linalg.norm(marks[:, 3:] - marks[:, :3], axis=1)
    assert result["cases"][0]["rows"][bench.UNMOVED]["both"]["mean"] == pytest.approx(moved.mean())
    json.dumps(result)
    assert f"{moved.mean():.2f}" in bench.table(result)


def test_a_lung_on_its_back_empties_there() -> None:
    points = np.column_stack([np.zeros(5), np.linspace(-80.0, 120.0, 5), np.full(5, 7.0)])
    down = bench.emptied(points, 0.3)
    assert_allclose(down[:, 1], -60 * np.array([0, 0.1875, 0.25, 0.1875, 0]))
    assert_allclose(down[:, [0, 2]], 0)


def test_dependent_emptying_turns_round_with_the_breath(person_folder: Path) -> None:
    person = read_person(person_folder)
    for deflate, sign in ((True, -1), (False, 1)):
        motion = person.motions(deflate, bench.EDGE_MM)[0]
        moved = bench.by_dependent_emptying(motion) - bench.by_sliding_elasticity(motion)
        assert 3 < sign * np.median(moved[:, 1]) < 12


def test_a_folder_that_lacks_a_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match=r"lacks lungs_inspiration.nii.gz and lungs_expiration.nii.gz and landmarks"):
        read_person(tmp_path)


@pytest.mark.parametrize(
    ("text", "error", "says"),
    [
        ("x,y,z\n1,2,3\n", CaseError, "write insp_x"),
        ("insp_x,insp_y,insp_z,exp_x,exp_y,exp_z\n1,2,3,4,5,six\n", InputRefused, "six"),
        ("insp_x,insp_y,insp_z,exp_x,exp_y,exp_z\n1,2,3,4,5,nan\n", InputRefused, "finite"),
        ("insp_x,insp_y,insp_z,exp_x,exp_y,exp_z\n1,2,3\n", InputRefused, "six finite"),
    ],
)
def test_bad_landmarks_are_refused(tmp_path: Path, text: str, error: type[Exception], says: str) -> None:
    for name in ("lungs_inspiration.nii.gz", "lungs_expiration.nii.gz"):
        (tmp_path / name).touch()
    (tmp_path / "landmarks_ras_mm.csv").write_text(text)
    with pytest.raises(error, match=says):
        read_person(tmp_path)


def test_a_mask_without_lungs_is_refused(person_folder: Path, tmp_path: Path) -> None:
    image = nib.load(person_folder / "lungs_expiration.nii.gz")
    speck = np.zeros(image.shape, np.uint8)
    speck[10:12, 10:12, 10:12] = 1
    nib.save(nib.Nifti1Image(speck, image.affine), tmp_path / "lungs_expiration.nii.gz")
    for name in ("lungs_inspiration.nii.gz", "landmarks_ras_mm.csv"):
        (tmp_path / name).write_bytes((person_folder / name).read_bytes())
    with pytest.raises(InputRefused, match="0 ml of the left lung"):
        read_person(tmp_path)
