"""The output set: complete, in LPS, on the grids of the input files, and readable by the readers of the formats."""

from __future__ import annotations

import dataclasses
import json

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.maps.field import DisplacementField
from registration.volume import Mask, Volume, axis_codes
from vatsloc.formats.folder import is_result, whole_folder
from vatsloc.formats.meshes import Surface, TetraMesh
from vatsloc.results import (
    CT_IN_DEFLATED,
    INFLATED_FROM_CT,
    INPUTS,
    NODULE_MASK,
    OUTPUT_FILES,
    REPORT,
    SCENE,
    SCENE_WITH_SCANS,
    ResultData,
    RunRecord,
    read_run,
    write_results,
)

NODULE = np.array([10.0, 20.0, 30.0])
LPS_GRID = np.diag([-2.0, -2.0, 3.0, 1.0])
POINTS = np.array([[10.0, 20, 30], [11, 20, 30], [10, 22, 30], [10, 20, 33]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def record(**changes) -> RunRecord:
    values = {
        "status": "done",
        "nodule_lps": NODULE * [-1, -1, 1],
        "nodule_ellipsoid95_mm": np.array([4.0, 3.0, 2.0], dtype=np.float32),
        "theta": {"kappa_b": np.float64(1e-8), "phi": 0.8, "d_diaph_mm": np.nan},
        "seconds": {"total": 61.5, "pose": np.float32(20.5)},
        "peak_mb": 1234.5,
        "gates": {"overlap": {"ok": np.bool_(True), "value": 0.9, "limit": 0.4}},
        "warnings": ("one",),
        "details": {"seed": 7, "inputs": {"ct": "ab"}},
    }
    return RunRecord(**{**values, **changes})


def result() -> ResultData:
    rng = np.random.default_rng(0)
    shape = (4, 5, 6)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), [1, 2, 3]
    inside = np.zeros(shape, dtype=bool)
    inside[1, 2, 3] = True

    def image() -> Volume:
        return Volume(rng.integers(-1000, 1000, shape).astype(np.float32), LPS_GRID)

    def field() -> DisplacementField:
        return DisplacementField(rng.normal(0, 5, (*shape, 3)).astype(np.float32), LPS_GRID)

    def lung() -> TetraMesh:
        return TetraMesh(POINTS, np.array([[0, 1, 2, 3]]), {"pressure": np.arange(4.0)}, {"det F": np.array([0.5])})

    return ResultData(
        nodule_inflated_ras=NODULE - 5,
        nodule_deflated_ras=NODULE,
        nodule_mask_deflated=Mask(inside, LPS_GRID),
        ct_in_inflated=image(),
        ct_in_deflated=image(),
        lung_ct=lung(),
        lung_inflated=lung(),
        lung_deflated=lung(),
        deflated_surface=Surface(POINTS, FACES),
        contact_surface=Surface(POINTS, FACES),
        inflated_from_ct=field(),
        deflated_from_ct=field(),
        ct_from_inflated=field(),
        ct_from_deflated=field(),
        rigid_inflated_from_ct=rigid,
        rigid_deflated_from_inflated=np.linalg.inv(rigid),
        run=record(),
        stored_axes={"ct": "RAS", "cbct_inflated": "LPS", "cbct_deflated": "SAL"},
    )


def test_output_set_is_complete_and_a_result(tmp_path):
    with whole_folder(tmp_path / "out", expected=OUTPUT_FILES) as folder:
        write_results(folder, result())
        for name in (INPUTS, REPORT, SCENE, SCENE_WITH_SCANS):  # modules of their own write these
            (folder / name).write_text("<html></html>")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(OUTPUT_FILES)
    assert is_result(tmp_path / "out")


def test_images_get_the_voxel_order_of_the_input_files(tmp_path):
    data = result()
    write_results(tmp_path, data)
    assert axis_codes(nibabel.load(tmp_path / INFLATED_FROM_CT).affine) == "RAS"
    warped, mask = nibabel.load(tmp_path / CT_IN_DEFLATED), nibabel.load(tmp_path / NODULE_MASK)
    assert axis_codes(warped.affine) == axis_codes(mask.affine) == "SAL"
    assert warped.shape == (6, 5, 4)
    (ijk,) = np.argwhere(np.asarray(mask.dataobj))
    assert_allclose(mask.affine[:3, :3] @ ijk + mask.affine[:3, 3], [-2, -4, 9])
    assert float(warped.dataobj[tuple(ijk)]) == data.ct_in_deflated.hu[1, 2, 3]


def test_same_data_give_the_same_bytes(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write_results(tmp_path / name, result())
    for name in OUTPUT_FILES:
        if name not in (INPUTS, REPORT, SCENE, SCENE_WITH_SCANS):
            assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_run_json_has_the_promised_keys_and_plain_values(tmp_path):
    write_results(tmp_path, result())
    run = read_run(tmp_path)
    assert run["nodule_lps"] == [-10.0, -20.0, 30.0]
    assert run["nodule_ellipsoid95_mm"] == [4.0, 3.0, 2.0]
    assert run["theta"] == {"kappa_b": 1e-8, "phi": 0.8, "d_diaph_mm": None}
    assert run["seconds"] == {"total": 61.5, "pose": 20.5}
    assert run["gates"] == {"overlap": {"ok": True, "value": 0.9, "limit": 0.4}}
    assert (run["skipped"], run["warnings"], run["peak_mb"], run["status"]) == ({}, ["one"], 1234.5, "done")
    assert (run["seed"], run["inputs"], run["program"]) == (7, {"ct": "ab"}, "vatsloc")
    assert {"vatsloc", "python", "numpy"} <= set(run["versions"])
    assert json.dumps(run, allow_nan=False)


def test_run_record_checks_itself():
    with pytest.raises(ValueError, match='must hold "total"'):
        record(seconds={"pose": 1.0}).as_json()
    with pytest.raises(ValueError, match="details must not repeat status"):
        record(details={"status": "x"}).as_json()


def test_run_and_markups_cannot_disagree_on_the_nodule(tmp_path):
    data = dataclasses.replace(result(), run=record(nodule_lps=NODULE))
    with pytest.raises(ValueError, match="run says nodule_lps"):
        write_results(tmp_path, data)
