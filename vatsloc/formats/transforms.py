"""Linear transforms as ITK .tfm text files, parameters in LPS mm.

A file holds the map of points it is named after: from-A_to-B takes a point of A to B. ITK and Slicer resample with the
map from the fixed image's points to the moving one's, so both directions are written and each names its own.

    y = M (x - c) + c + t        parameters: M row by row, then t; fixed parameters: c

Ref: ITK Software Guide, book 2, section 3.9 (AffineTransform, Euler3DTransform, VersorRigid3DTransform).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from registration.volume import Array
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.frames import flip_transform

_HEADER = "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
_PARAMETERS = {
    "AffineTransform": 12,
    "MatrixOffsetTransformBase": 12,
    "Euler3DTransform": 6,
    "VersorRigid3DTransform": 6,
}
_VERSOR_ROUNDING = 1e-6
_LEAST_DETERMINANT = 1e-6
"""A map that flattens space loses points, which no transform between two images does."""


def write_tfm(path: Path, to_from_ras: Array) -> None:
    """Write a point map (4, 4) in RAS mm as ITK AffineTransform about the origin."""
    matrix = flip_transform(to_from_ras)
    parameters = " ".join(repr(float(v)) for v in [*matrix[:3, :3].ravel(), *matrix[:3, 3]])
    path.write_text(f"{_HEADER}Parameters: {parameters}\nFixedParameters: 0 0 0\n", encoding="ascii")


@guarded("ITK transform", "export the transform again")
def read_tfm(path: Path) -> Array:
    """Point map (4, 4) in RAS mm of an affine, Euler or versor transform.

    Raises CaseError when the file is not there, InputRefused when it is none of these or incomplete.
    """
    if not path.is_file():
        raise CaseError(f"{path} does not exist; correct the path or put the transform there.")
    lines = [line.partition(":") for line in path.read_text(errors="replace").splitlines() if not line.startswith("#")]
    entries = [(key.strip(), value.strip()) for key, colon, value in lines if colon]
    if sum(key == "Transform" for key, _ in entries) != 1:
        raise InputRefused(f"{path} does not hold exactly one ITK transform; export one linear transform as .tfm.")
    fields = dict(entries)
    kind = fields["Transform"].partition("_")[0]
    if kind not in _PARAMETERS:
        raise InputRefused(f"{path} holds a {fields['Transform']}; export a rigid or affine transform.")
    try:
        parameters = np.array(fields["Parameters"].split(), dtype=float)
        fixed = np.array(fields["FixedParameters"].split(), dtype=float)
    except (KeyError, ValueError) as error:
        raise InputRefused(f"{path} has unreadable parameters ({error}); export the transform again.") from error
    if len(parameters) != _PARAMETERS[kind] or len(fixed) not in (3, 4) or not np.isfinite([*parameters, *fixed]).all():
        raise InputRefused(
            f"{path} has {len(parameters)} parameters and {len(fixed)} fixed ones, {_PARAMETERS[kind]} and 3 finite "
            "numbers needed; export it again."
        )
    linear = _linear_part(kind, parameters, fixed)
    if not abs(np.linalg.det(linear)) > _LEAST_DETERMINANT:
        raise InputRefused(f"{path} maps space to a plane or turns it by no versor; export the transform again.")
    centre, matrix = fixed[:3], np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = parameters[-3:] + centre - linear @ centre
    return flip_transform(matrix)


def _linear_part(kind: str, parameters: Array, fixed: Array) -> Array:
    """M (3, 3); zeros for a versor longer than 1."""
    if kind == "Euler3DTransform":
        order = "ZYX" if len(fixed) > 3 and fixed[3] != 0 else "ZXY"
        angles = [parameters["XYZ".index(axis)] for axis in order]
        return np.asarray(Rotation.from_euler(order, angles).as_matrix())
    if kind == "VersorRigid3DTransform":
        versor = parameters[:3]
        rest = 1.0 - float(versor @ versor)
        if rest < -_VERSOR_ROUNDING:
            return np.zeros((3, 3))
        return np.asarray(Rotation.from_quat([*versor, np.sqrt(max(rest, 0.0))]).as_matrix())
    return parameters[:9].reshape(3, 3)
