"""Displacement fields: five axes, intents, and the frame of their vectors."""

from __future__ import annotations

import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from registration.maps.field import DisplacementField
from vatsloc.errors import InputRefused
from vatsloc.formats.fields import STEP_MM, read_field, write_field

OBLIQUE = np.eye(4)
OBLIQUE[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix() * [-1.5, 1.0, 2.0]
OBLIQUE[:3, 3] = [10, -20, 30]


@pytest.fixture(params=["RAS", "LPS", "oblique"])
def field(request) -> DisplacementField:
    affine = {"RAS": np.diag([1.0, 2, 3, 1]), "LPS": np.diag([-1.0, -2, 3, 1]), "oblique": OBLIQUE}[request.param]
    vectors = np.random.default_rng(1).normal(0, 10, (4, 5, 6, 3)).astype(np.float32)
    return DisplacementField(vectors, affine)


@pytest.mark.parametrize("axes", [None, "RAS", "SPL"])
def test_written_field_moves_points_as_before(tmp_path, field, axes):
    write_field(tmp_path / "f.nii.gz", field, axes)
    points = field.grid.points()[1:-1, 1:-1, 1:-1].reshape(-1, 3)
    assert_allclose(read_field(tmp_path / "f.nii.gz")(points), field(points), atol=STEP_MM)


def test_file_is_what_itk_and_ants_expect(tmp_path):
    vectors = np.zeros((2, 3, 4, 3), dtype=np.float32)
    vectors[1, 2, 3] = [1.5, 2.5, 3.5]
    write_field(tmp_path / "f.nii.gz", DisplacementField(vectors, np.eye(4)))
    image = nibabel.load(tmp_path / "f.nii.gz")
    assert image.shape == (2, 3, 4, 1, 3)
    assert int(image.header["intent_code"]) == 1007
    assert image.header.get_data_dtype() == np.float32
    assert_allclose(np.asarray(image.dataobj)[1, 2, 3, 0], [-1.5, -2.5, 3.5])


def test_ras_vectors_of_intent_1006_are_not_flipped(tmp_path):
    values = np.zeros((2, 3, 4, 1, 3), dtype=np.float32)
    values[1, 2, 3, 0] = [1.5, 2.5, 3.5]
    image = nibabel.Nifti1Image(values, np.eye(4))
    image.header["intent_code"] = 1006
    nibabel.save(image, tmp_path / "f.nii.gz")
    assert_allclose(read_field(tmp_path / "f.nii.gz").vectors[1, 2, 3], [1.5, 2.5, 3.5])


@pytest.mark.parametrize(
    ("shape", "intent", "value", "sentence"),
    [
        ((2, 3, 4, 3), 1007, 0.0, "2 x 3 x 4 x 3 values, ni x nj x nk x 1 x 3 needed"),
        ((2, 3, 4, 1, 2), 1007, 0.0, "2 x 3 x 4 x 1 x 2 values"),
        ((2, 3, 4, 1, 3), 0, 0.0, r"intent 0, 1007 \(LPS\) or 1006 \(RAS\) needed"),
        ((2, 3, 4, 1, 3), 1007, np.nan, "displacements that are not finite"),
    ],
)
def test_refusals(tmp_path, shape, intent, value, sentence):
    image = nibabel.Nifti1Image(np.full(shape, value, dtype=np.float32), np.eye(4))
    image.header["intent_code"] = intent
    nibabel.save(image, tmp_path / "f.nii.gz")
    with pytest.raises(InputRefused, match=sentence):
        read_field(tmp_path / "f.nii.gz")


def test_displacements_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="not finite"):
        write_field(tmp_path / "f.nii.gz", DisplacementField(np.full((2, 2, 2, 3), np.inf), np.eye(4)))
