"""Benchmark on real lungs: what its folders must hold, its yardsticks by value, and scores of a known motion."""

from __future__ import annotations

import json
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from matplotlib.axes import Axes
from numpy.testing import assert_allclose
from scipy import ndimage

from poro.arrays import Array
from poro.breathing.affine import affine_to_points, affine_to_shape
from poro.breathing.elastic import Lung
from poro.mesh import TetMesh
from registration.volume import Mask
from vatsloc.breathing.case import LANDMARKS
from vatsloc.breathing.masks import to_the_back
from vatsloc.errors import CaseError, InputRefused
from vatsloc.study.bench import real as bench
from vatsloc.study.bench import real_draw, real_images
from vatsloc.study.bench.breaths import Marks, read_person
from vatsloc.study.bench.poro_lung import lung, wall_level

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
    (case,) = result["cases"]
    assert [way["direction"] for way in (case, case["back"])] == [
        "inspiration to expiration",
        "expiration to inspiration",
    ]
    for way in (case, case["back"]):
        rows = way["rows"]
        assert {lung: row["n"] for lung, row in rows[bench.UNMOVED].items()} == {"left": 40, "right": 40, "both": 80}
        assert rows[bench.TRUE_AFFINE]["both"]["max"] < 1e-9
        assert way["initial_mean"] == rows[bench.UNMOVED]["both"]["mean"]
        assert {key: way[key] for key in ("mean", "p95", "max")} == {
            key: rows[bench.BY_DEPTH]["both"][key] for key in ("mean", "p95", "max")
        }
    assert case["name"] == "squeezed"
    assert case["seconds"] > 0
    marks = np.loadtxt(person_folder / "landmarks_ras_mm.csv", delimiter=",", skiprows=1)
    moved = np.linalg.norm(marks[:, 3:] - marks[:, :3], axis=1)
    assert case["initial_mean"] == pytest.approx(moved.mean())
    json.dumps(result)
    assert f"{moved.mean():.2f}" in bench.table(result)


@pytest.mark.parametrize("name", [bench.SHAPE_AFFINE, bench.ELASTIC])
def test_shape_alone_finds_a_squeeze(name: str) -> None:
    body, other = lung(6_000).mesh, lung(9_000).mesh
    shape = Lung("right", body, TetMesh(squeeze(other.points, np.zeros(3)), other.tets))
    marks = body.points[np.linalg.norm(body.points, axis=1) < 60]
    out, back = bench.errors(shape, bench.ROWS[name](shape), Marks(marks, squeeze(marks, np.zeros(3))))
    assert out.mean() < 1.0
    assert back.mean() < 1.0


def test_landmarks_only_score(person_folder: Path, tmp_path: Path) -> None:
    for name in ("lungs_inspiration.nii.gz", "lungs_expiration.nii.gz"):
        (tmp_path / name).write_bytes((person_folder / name).read_bytes())
    table = np.loadtxt(person_folder / LANDMARKS, delimiter=",", skiprows=1) + np.random.default_rng(5).normal(0, 20, 6)
    header = ",".join(f"{breath}_{axis}" for breath in ("insp", "exp") for axis in "xyz")
    np.savetxt(tmp_path / LANDMARKS, table, delimiter=",", header=header, comments="")
    one, other = (read_person(folder, 20.0) for folder in (person_folder, tmp_path))
    assert not np.allclose(one.marks("left").expired[:5], other.marks("left").expired[:5])
    for mine, theirs in zip(one.lungs, other.lungs, strict=True):
        for predict in bench.ROWS.values():
            assert_allclose(predict(mine), predict(theirs), atol=1e-9)


def test_errors_are_those_of_the_map_and_of_its_inverse() -> None:
    mesh = lung(6_000).mesh
    marks = np.array([[0.0, 0.0, 0.0], [10.0, -15.0, 20.0]])
    moved = squeeze(mesh.points, np.zeros(3))
    known = Marks(marks, squeeze(marks, np.zeros(3)) + np.array([0.0, 3.0, 4.0]))
    out, back = bench.errors(Lung("right", mesh, mesh), moved, known)
    assert_allclose(out, 5.0, atol=1e-9)
    assert_allclose(back, np.linalg.norm(np.linalg.inv(SQUEEZE) @ [0.0, 3.0, 4.0]), atol=1e-9)


def test_errors_are_drawn_for_each_lung_and_view(
    person_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[Array, Array]] = []
    monkeypatch.setattr(real_draw, "ROWS", dict.fromkeys(bench.ROWS, bench.ROWS[bench.UNMOVED]))
    monkeypatch.setattr(Axes, "quiver", lambda self, x, y, u, v, **_: drawn.append((x + u, y + v)))
    real_draw.draw_real([person_folder], tmp_path / "errors.png")
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    assert len(drawn) == 8
    truth = read_person(person_folder).marks("left").expired
    assert_allclose(drawn[0], truth[:, 1:].T)
    assert_allclose(drawn[1], truth[:, ::2].T)


def write_chest(folder: Path) -> Path:
    """A right lung with vessels that is squeezed a little inside flesh: images and masks of both states."""
    spacing, shape = 3.0, (76, 55, 74)
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = [-90.0, -82.0, -110.0]
    grid = np.stack(np.meshgrid(*(np.arange(n) * spacing for n in shape), indexing="ij"), -1) + affine[:3, 3]
    matrix, shift, centre = np.diag([0.95, 0.94, 0.95]), np.array([0.0, -2.0, 3.0]), CENTRES["right"]
    back = (grid - centre - shift) @ np.linalg.inv(matrix).T + centre
    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal(shape), 1.2)
    folder.mkdir()
    for name, place in (("first", grid), ("second", back)):
        inside = wall_level(place - centre) > 0
        at = np.moveaxis((place - affine[:3, 3]) / spacing, -1, 0)
        texture = ndimage.map_coordinates(noise / noise.std(), at, order=1, mode="nearest")
        hu = np.where(inside, -800 + 300 * np.maximum(texture - 0.5, 0), 40).astype(np.float32)
        nib.save(nib.Nifti1Image(hu, affine), folder / f"chest_{name}.nii.gz")
        nib.save(nib.Nifti1Image(inside.astype(np.uint8), affine), folder / f"right_lung_{name}.nii.gz")
    marks = np.array([[60.0, 0.0, 0.0], [70.0, 20.0, -30.0], [55.0, -20.0, 30.0]])
    rows = np.hstack([marks, (marks - centre) @ matrix.T + centre + shift])
    header = "first_x,first_y,first_z,second_x,second_y,second_z"
    np.savetxt(folder / LANDMARKS, rows, delimiter=",", header=header, comments="")
    return folder


def test_images_of_two_states_are_registered_there_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(real_images, "elastix_version", lambda: None)
    monkeypatch.setattr(bench, "ROWS", {name: bench.ROWS[name] for name in (bench.UNMOVED, bench.SHAPE_AFFINE)})
    by_shape = bench.ROWS[bench.SHAPE_AFFINE]
    monkeypatch.setattr(bench, "predicted", lambda name, pair: bench.ROWS.get(name, by_shape)(pair.lung))
    (case,) = bench.bench_real([write_chest(tmp_path / "chest")])["cases"]
    found = case["images"]["right"]
    classes = [row for row in found["by_depth"] if row["n"] > 50]
    assert [row["from_mm"] for row in classes][:3] == [0.0, 5.0, 10.0]
    assert all(row["motion"]["mean"] > 2 for row in classes)
    # A third of a voxel at the pleura, a sixth below.
    for way in ("there_and_back", "phase1"):
        assert all(row[way]["mean"] < (1.0 if row["from_mm"] < 10 else 0.5) for row in classes)
        assert all(row[way]["mean"] > 0.01 for row in classes)
    assert classes[0]["phase1"] != classes[0]["there_and_back"]
    assert found["agreed_share"] > 0.8
    assert found["elastix_version"] is None
    # The squeeze is an affine map, which the fit to the shape finds and a lung at rest does not.
    assert found["rows"][bench.SHAPE_AFFINE]["mean"] < 1.0
    assert found["rows"][bench.UNMOVED]["mean"] > 2.0
    text = bench.table({"cases": [case]})
    assert "chest, right lung, registered there and back" in text
    assert f"({100 * found['agreed_share']:.0f} % of the tissue)" in text


def test_masks_as_people_have_them_are_mended(person_folder: Path, tmp_path: Path) -> None:
    image = nib.load(person_folder / "lungs_expiration.nii.gz")
    torn = np.asarray(image.dataobj).copy()
    torn[:, :, 40] = 0
    torn[2:8, 2:8, 2:8] = 1
    nib.save(nib.Nifti1Image(torn, image.affine), tmp_path / "lungs_expiration.nii.gz")
    for name in ("lungs_inspiration.nii.gz", LANDMARKS):
        (tmp_path / name).write_bytes((person_folder / name).read_bytes())
    person, whole = read_person(tmp_path, 20.0), read_person(person_folder, 20.0)
    assert "The expiration mask: 1 slices were missing or torn and were filled in." in person.notes
    assert any("of stray bits were left out" in note for note in person.notes)
    for mended, known in zip(person.lungs, whole.lungs, strict=True):
        assert mended.expired.node_volumes.sum() == pytest.approx(known.expired.node_volumes.sum(), rel=0.01)


def test_what_lies_behind_an_expired_lung_is_filled_up_to_the_back_wall() -> None:
    full, thin = np.zeros((2, 5, 12, 4), bool)
    full[1:4, 2:11] = True  # in RAS the back lies at low j
    thin[1:3, 6:9] = True
    for flipped in (False, True):
        affine = np.diag([2.0, -2.0 if flipped else 2.0, 2.0, 1.0])
        step = -1 if flipped else 1
        filled = to_the_back(Mask(thin[:, ::step], affine), Mask(full[:, ::step], affine)).inside[:, ::step]
        assert filled[1:3, 2:9].all()
        assert filled.sum() == 2 * 7 * 4
        cropped = affine.copy()
        cropped[0, 3] = 2.0  # of voxels that start one further on, as those of another scan may
        again = to_the_back(Mask(thin[:, ::step], affine), Mask(full[1:, ::step], cropped))
        assert (again.inside[:, ::step] == filled).all()


def test_a_folder_that_lacks_a_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match=r"holds no breath.toml, nor lungs_inspiration.nii.gz and lungs_expiration"):
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
def test_bad_landmarks_are_refused(
    person_folder: Path, tmp_path: Path, text: str, error: type[Exception], says: str
) -> None:
    for name in ("lungs_inspiration.nii.gz", "lungs_expiration.nii.gz"):
        (tmp_path / name).write_bytes((person_folder / name).read_bytes())
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
    with pytest.raises(InputRefused, match="The expiration mask holds 0 ml of lung"):
        read_person(tmp_path)
