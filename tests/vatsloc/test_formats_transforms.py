"""ITK transform files: LPS, centre of rotation, and the kinds ITK and Slicer write."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.transforms import read_tfm, write_tfm
from vatsloc.frames import flip_points

HEAD = "#Insight Transform File V1.0\n#Transform 0\n"


def tfm(path, kind, parameters, fixed):
    numbers = " ".join(map(str, parameters)), " ".join(map(str, fixed))
    path.write_text(f"{HEAD}Transform: {kind}\nParameters: {numbers[0]}\nFixedParameters: {numbers[1]}\n")
    return path


def rotations(about_x=0.0, about_y=0.0, about_z=0.0):
    """Elementary rotation matrices, spelt out to be independent of the reader's library."""
    c, s = np.cos([about_x, about_y, about_z]), np.sin([about_x, about_y, about_z])
    return (
        np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]]),
        np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]]),
        np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]]),
    )


def apply_lps(matrix_ras, point_lps):
    point = flip_points(np.asarray(point_lps, dtype=float))
    return flip_points(matrix_ras[:3, :3] @ point + matrix_ras[:3, 3])


def test_written_transform_comes_back(tmp_path):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec([0.1, -0.4, 0.3]).as_matrix(), [12.25, -7.5, 3.125]
    write_tfm(tmp_path / "t.tfm", matrix)
    assert_allclose(read_tfm(tmp_path / "t.tfm"), matrix, atol=1e-15)


def test_translation_is_written_in_lps(tmp_path):
    matrix = np.eye(4)
    matrix[:3, 3] = [10.0, 20.0, 30.0]
    write_tfm(tmp_path / "t.tfm", matrix)
    lines = (tmp_path / "t.tfm").read_text().splitlines()
    assert lines[2] == "Transform: AffineTransform_double_3_3"
    assert lines[3].split()[10:] == ["-10.0", "-20.0", "30.0"]


@pytest.mark.parametrize("kind", ["AffineTransform_double_3_3", "MatrixOffsetTransformBase_float_3_3"])
def test_affine_turns_about_its_centre(tmp_path, kind):
    matrix, centre, shift = (
        np.array([[0.9, 0.1, 0], [-0.2, 1.1, 0.05], [0, 0, 1]]),
        np.array([5.0, 6, 7]),
        np.array([1.0, 2, 3]),
    )
    read = read_tfm(tfm(tmp_path / "t.tfm", kind, [*matrix.ravel(), *shift], centre))
    assert_allclose(apply_lps(read, centre), centre + shift)
    assert_allclose(apply_lps(read, [1.0, -2, 4]), matrix @ (np.array([1.0, -2, 4]) - centre) + centre + shift)


@pytest.mark.parametrize(("zyx", "order"), [((), "zxy"), ((0,), "zxy"), ((1,), "zyx")])
def test_euler_angles_in_both_orders(tmp_path, zyx, order):
    angles, centre, shift = (0.2, -0.3, 0.5), np.array([4.0, -5, 6]), np.array([1.0, 2, 3])
    rx, ry, rz = rotations(*angles)
    expected = rz @ rx @ ry if order == "zxy" else rz @ ry @ rx
    read = read_tfm(tfm(tmp_path / "t.tfm", "Euler3DTransform_double_3_3", [*angles, *shift], [*centre, *zyx]))
    point = np.array([10.0, 20, -30])
    assert_allclose(apply_lps(read, point), expected @ (point - centre) + centre + shift, atol=1e-12)


def test_versor(tmp_path):
    half = 0.35
    read = read_tfm(
        tfm(tmp_path / "t.tfm", "VersorRigid3DTransform_double_3_3", [0, 0, np.sin(half), 1, 2, 3], [0, 0, 0])
    )
    assert_allclose(apply_lps(read, [10.0, 0, 0]), rotations(0, 0, 2 * half)[2] @ [10.0, 0, 0] + [1, 2, 3], atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "parameters", "fixed", "sentence"),
    [
        ("BSplineTransform_double_3_3", [0] * 12, [0, 0, 0], "holds a BSplineTransform_double_3_3; export a rigid"),
        ("AffineTransform_double_3_3", [1] * 11, [0, 0, 0], "11 parameters and 3 fixed ones"),
        ("AffineTransform_double_3_3", [1] * 5, [0, 0, 0], "5 parameters and 3 fixed ones"),
        ("AffineTransform_double_3_3", ["x"] * 12, [0, 0, 0], "unreadable parameters"),
        ("AffineTransform_double_3_3", ["nan"] * 12, [0, 0, 0], "12 parameters"),
        ("Euler3DTransform_double_3_3", [0] * 6, [0], "6 parameters and 1 fixed ones"),
    ],
)
def test_refusals(tmp_path, kind, parameters, fixed, sentence):
    with pytest.raises(InputRefused, match=sentence):
        read_tfm(tfm(tmp_path / "t.tfm", kind, parameters, fixed))


def test_composite_is_refused(tmp_path):
    one = "Transform: AffineTransform_double_3_3\nParameters: 1 0 0 0 1 0 0 0 1 0 0 0\nFixedParameters: 0 0 0\n"
    (tmp_path / "t.tfm").write_text(HEAD + one + "#Transform 1\n" + one)
    with pytest.raises(InputRefused, match="not hold exactly one ITK transform"):
        read_tfm(tmp_path / "t.tfm")


def test_missing_file_is_a_case_error(tmp_path):
    with pytest.raises(CaseError, match="does not exist"):
        read_tfm(tmp_path / "t.tfm")
