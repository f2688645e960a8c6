"""Every file of a results folder read back against its own source, where no two sources are alike."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from registration.maps.field import DisplacementField
from registration.maps.rigid import RigidTransform
from registration.volume import Array, Grid, Mask, Volume, axis_codes
from tests.vatsloc.run_scene import lps_grid
from vatsloc import results
from vatsloc.evaluation import read_result, read_truth
from vatsloc.formats.fields import read_field
from vatsloc.formats.images import read_mask, read_volume
from vatsloc.formats.markups import PointList, read_points, write_points
from vatsloc.formats.meshes import Surface, TetraMesh, read_surface, read_vtu
from vatsloc.formats.nifti import read_nifti, write_volume
from vatsloc.formats.transforms import read_tfm
from vatsloc.frames import reorient
from vatsloc.results import ResultData, RunRecord, read_run, write_results

AXES = {"ct": "RAS", "cbct_inflated": "LPS", "cbct_deflated": "SAL"}
CT, INFLATED, DEFLATED = (
    lps_grid(shape, spacing, np.array(centre))
    for shape, spacing, centre in (
        ((5, 6, 7), (1.0, 1.5, 2.0), (10.0, 20.0, 30.0)),
        ((6, 4, 5), (1.2, 1.1, 1.3), (-15.0, 25.0, 35.0)),
        ((4, 7, 3), (1.4, 1.6, 1.7), (12.0, -22.0, 33.0)),
    )
)
INFLATED_FROM_CT = RigidTransform.about(np.ones(3), np.array([0.1, 0.2, 0.3]), np.array([1.0, 2, 3]))
DEFLATED_FROM_INFLATED = RigidTransform.about(np.ones(3), np.array([-0.3, 0.1, 0.2]), np.array([-4.0, 5, 6]))


@pytest.fixture(scope="module")
def data() -> ResultData:
    rng = np.random.default_rng(3)

    def field(grid: Grid) -> DisplacementField:
        return DisplacementField(rng.normal(0, 5, (*grid.shape, 3)).astype(np.float32), grid.ras_from_ijk)

    def image(grid: Grid) -> Volume:
        return Volume(rng.integers(-1000, 1000, grid.shape).astype(np.float32), grid.ras_from_ijk)

    def lung() -> TetraMesh:
        nodal = {name: rng.normal(size=5) for name in ("pressure_kpa", "contact_pressure_kpa", "radius95_mm")}
        nodal["displacement"] = rng.normal(size=(5, 3))
        tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
        return TetraMesh(rng.normal(0, 30, (5, 3)), tets, nodal, {"det_f": rng.normal(size=2)})

    def skin() -> Surface:
        faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
        return Surface(rng.normal(0, 30, (4, 3)), rng.permutation(faces))

    nodule = np.array([3.0, 1.0, 2.0])
    return ResultData(
        nodule_inflated_ras=np.array([7.0, -8.0, 9.0]),
        nodule_deflated_ras=nodule,
        nodule_mask_deflated=Mask(rng.random(DEFLATED.shape) < 0.3, DEFLATED.ras_from_ijk),
        ct_in_inflated=image(INFLATED),
        ct_in_deflated=image(DEFLATED),
        lung_ct=lung(),
        lung_inflated=lung(),
        lung_deflated=lung(),
        deflated_surface=skin(),
        contact_surface=skin(),
        inflated_from_ct=field(CT.box(np.array([1, 0, 2]), np.array([4, 4, 6]))),
        deflated_from_ct=field(CT.box(np.array([0, 2, 1]), np.array([5, 6, 5]))),
        ct_from_inflated=field(INFLATED),
        ct_from_deflated=field(DEFLATED),
        rigid_inflated_from_ct=INFLATED_FROM_CT.matrix,
        rigid_deflated_from_inflated=DEFLATED_FROM_INFLATED.matrix,
        run=_run(nodule * [-1, -1, 1]),
        stored_axes=AXES,
    )


def _run(nodule_lps: Array) -> RunRecord:
    return RunRecord(
        status="gate failed",
        nodule_lps=nodule_lps,
        nodule_ellipsoid95_mm=np.array([4.0, 3.0, 2.0]),
        theta={"kappa_b": 1e-8, "phi": 0.8, "d_diaph_mm": 12.0},
        seconds={"total": 61.5, "pose": 20.5},
        peak_mb=1234.5,
        skipped={"this": "not needed"},
        gates={"overlap": {"ok": False, "value": 0.3, "limit": 0.4}},
        warnings=("first", "second"),
        details={"seed": 7},
    )


@pytest.fixture(scope="module")
def folder(data: ResultData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result")
    write_results(out, data)
    return out


READ: dict[Any, tuple[Callable[[Path], Any], str]] = {
    DisplacementField: (read_field, "vectors"),
    Volume: (read_volume, "hu"),
    Mask: (read_mask, "inside"),
}


@pytest.mark.parametrize(
    ("file", "source", "axes"),
    [
        ("from-CT_to-CBCTinflated_mode-points_xfm.nii.gz", "inflated_from_ct", "RAS"),
        ("from-CT_to-CBCTdeflated_mode-points_xfm.nii.gz", "deflated_from_ct", "RAS"),
        ("from-CBCTinflated_to-CT_mode-image_xfm.nii.gz", "ct_from_inflated", "LPS"),
        ("from-CBCTdeflated_to-CT_mode-image_xfm.nii.gz", "ct_from_deflated", "SAL"),
        ("ct_in_cbct_inflated.nii.gz", "ct_in_inflated", "LPS"),
        ("ct_in_cbct_deflated.nii.gz", "ct_in_deflated", "SAL"),
        ("nodule_cbct_deflated.nii.gz", "nodule_mask_deflated", "SAL"),
    ],
)
def test_each_field_and_image_is_in_the_file_that_names_it(
    folder: Path, data: ResultData, file: str, source: str, axes: str
) -> None:
    wanted = getattr(data, source)
    read, voxels = READ[type(wanted)]
    found = read(folder / file)
    assert axis_codes(read_nifti(folder / file).ras_from_ijk) == axes
    values, affine = reorient(getattr(wanted, voxels), wanted.ras_from_ijk, axis_codes(found.ras_from_ijk))
    assert found.grid.same_as(Grid((values.shape[0], values.shape[1], values.shape[2]), affine))
    # Fields are rounded to 2**-10 mm; images here hold whole numbers.
    assert_allclose(getattr(found, voxels).astype(float), values, atol=0.6 * 2**-10)


@pytest.mark.parametrize("state", ["ct", "inflated", "deflated"])
def test_each_lung_keeps_its_own_points_and_values(folder: Path, data: ResultData, state: str) -> None:
    found, lung = read_vtu(folder / f"lung_{state}.vtu"), getattr(data, f"lung_{state}")
    assert_allclose(found.points_ras, lung.points_ras)
    assert_array_equal(found.tets, lung.tets)
    assert set(found.point_data) == set(lung.point_data)
    for name, values in lung.point_data.items():
        assert_allclose(found.point_data[name], values, err_msg=name)
    assert_allclose(found.cell_data["det_f"], lung.cell_data["det_f"])


@pytest.mark.parametrize(
    ("file", "source"), [("lung_deflated.stl", "deflated_surface"), ("contact_surface.stl", "contact_surface")]
)
def test_each_surface_is_in_the_file_that_names_it(folder: Path, data: ResultData, file: str, source: str) -> None:
    found, surface = read_surface(folder / file), getattr(data, source)
    corners = surface.points_ras[surface.triangles]
    assert_allclose(found.points_ras[found.triangles], corners, rtol=1e-6)


def test_each_nodule_is_in_the_file_that_names_it(folder: Path) -> None:
    assert_allclose(read_points(folder / "nodule_cbct_inflated.mrk.json").ras, [[7, -8, 9]])
    assert_allclose(read_points(folder / "nodule_cbct_deflated.mrk.json").ras, [[3, 1, 2]])
    (entry,) = json.loads((folder / "nodule_cbct_deflated.mrk.json").read_text())["markups"][0]["controlPoints"]
    assert entry["position"] == [-3.0, -1.0, 2.0]


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("from-CT_to-CBCTinflated_mode-points", INFLATED_FROM_CT),
        ("from-CBCTinflated_to-CT_mode-image", INFLATED_FROM_CT.inverse()),
        ("from-CBCTinflated_to-CBCTdeflated_mode-points", DEFLATED_FROM_INFLATED),
        ("from-CBCTdeflated_to-CBCTinflated_mode-image", DEFLATED_FROM_INFLATED.inverse()),
    ],
)
def test_each_rigid_part_takes_points_the_way_its_name_says(folder: Path, file: str, source: RigidTransform) -> None:
    assert_allclose(read_tfm(folder / f"{file}_desc-rigid_xfm.tfm"), source.matrix, atol=1e-12)


def test_run_json_is_the_record(folder: Path, data: ResultData) -> None:
    run = read_run(folder)
    assert run["nodule_lps"] == [-3.0, -1.0, 2.0]
    assert run["nodule_ellipsoid95_mm"] == [4.0, 3.0, 2.0]
    for key in ("status", "theta", "seconds", "peak_mb", "skipped", "gates"):
        assert run[key] == getattr(data.run, key), key
    assert (run["warnings"], run["seed"]) == (["first", "second"], 7)


def test_the_evaluation_reads_each_part_from_the_file_that_names_it(folder: Path, data: ResultData) -> None:
    found = read_result(folder)
    def_from_ct = DEFLATED_FROM_INFLATED.matrix @ INFLATED_FROM_CT.matrix
    for rigid, matrix in (
        (found.maps.rigid_inf_from_ct, INFLATED_FROM_CT.matrix),
        (found.maps.rigid_def_from_inf, DEFLATED_FROM_INFLATED.matrix),
        (found.maps.rigid_def_from_ct, def_from_ct),
    ):
        assert_allclose(rigid(np.eye(3)), np.eye(3) @ matrix[:3, :3].T + matrix[:3, 3])
    for field, source in (
        (found.maps.inf_from_ct, data.inflated_from_ct),
        (found.maps.def_from_ct, data.deflated_from_ct),
        (found.field, data.deflated_from_ct),
    ):
        points = source.grid.points()[1:-1, 1:-1, 1:-1].reshape(-1, 3)
        assert_allclose(field(points), source(points), atol=1e-3)
    lungs = {state: getattr(data, f"lung_{state}").points_ras for state in ("ct", "inflated", "deflated")}
    assert_allclose(found.lung_ct.points, lungs["ct"])
    assert_allclose(found.lung_inflated.points, lungs["inflated"])
    phase2: Any = found.maps.def_from_inf
    assert_allclose(phase2.mesh.points, lungs["inflated"])
    assert_allclose(phase2.moved, lungs["deflated"])
    assert_allclose(phase2.around.matrix, DEFLATED_FROM_INFLATED.matrix, atol=1e-12)
    assert_allclose(found.radius95_mm, data.lung_deflated.point_data["radius95_mm"])
    assert_allclose(found.nodule_inflated_ras, [7, -8, 9])
    assert_allclose(found.nodule_deflated_ras, [3, 1, 2])
    assert found.run == read_run(folder)


def test_the_evaluation_reads_each_truth_from_the_file_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    images = [f'{name} = "{name}.nii.gz"' for name in AXES]
    lines = ['side = "right"', "[images]", *images, "[nodule]", 'point = "n.mrk.json"']
    (tmp_path / "case.toml").write_text("\n".join(lines))
    noise = np.random.default_rng(4)
    points = {name: noise.normal(0, 20, (3, 3)) for name in AXES}
    nodules = {"cbct_inflated": [[1.0, 2, 3]], "cbct_deflated": [[4.0, 5, 6]]}
    for name, grid in zip(AXES, (CT, INFLATED, DEFLATED), strict=True):
        image = noise.normal(-400, 300, (*grid.shape[:2], 40)).astype(np.float32)
        write_volume(tmp_path / f"{name}.nii.gz", Volume(image, grid.ras_from_ijk))
        write_points(tmp_path / f"landmarks_{name}.mrk.json", PointList(points[name], ("a", "b", "c")))
    for name, nodule in nodules.items():
        write_points(tmp_path / "truth" / f"nodule_{name}.mrk.json", PointList(np.array(nodule), ("n",)))
    np.savetxt(tmp_path / "truth" / "dense_ras_mm.csv", np.arange(18.0).reshape(2, 9), delimiter=",", header="x")
    truth = read_truth(tmp_path)
    assert_allclose(truth.landmarks.ct, points["ct"])
    assert_allclose(truth.landmarks.inflated, points["cbct_inflated"])
    assert_allclose(truth.landmarks.deflated, points["cbct_deflated"])
    assert_allclose(truth.nodule.nodule_inflated_ras, [1, 2, 3])
    assert_allclose(truth.nodule.nodule_deflated_ras, [4, 5, 6])
    for view, grid in (("inflated", INFLATED), ("deflated", DEFLATED)):
        assert truth.fields_of_view[view].grid.same_as(Grid((*grid.shape[:2], 40), grid.ras_from_ijk))
    assert_allclose(truth.dense, np.arange(18.0).reshape(2, 3, 3))


def test_every_output_has_a_name_of_its_own() -> None:
    assert len(set(results.OUTPUT_FILES)) == len(results.OUTPUT_FILES) == 24


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_record_of_another_nodule_is_refused(data: ResultData, tmp_path: Path, axis: int) -> None:
    off = np.array([-3.0, -1.0, 2.0]) + 0.01 * np.eye(3)[axis]
    with pytest.raises(ValueError, match="run says nodule_lps"):
        write_results(tmp_path, replace(data, run=_run(off)))
