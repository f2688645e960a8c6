"""Displacement fields as 5-D NIfTI, (ni, nj, nk, 1, 3): intent 1007 holds LPS vectors, intent 1006 RAS vectors.

A file named from-A_to-B_mode-points says where a point of A lies in B; one named from-B_to-A_mode-image lies on the
grid of image B and says, for each of its voxels, where in A to look: what ITK, ANTs and Slicer call the transform that
resamples A to B.
Ref: NIfTI-1 intent codes; ITK writes 1007 with LPS vectors, and since 5.4 may write 1006 with RAS vectors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from registration.maps.field import DisplacementField
from vatsloc.errors import InputRefused
from vatsloc.formats.guard import guarded
from vatsloc.formats.nifti import nifti_image, open_nifti, read_nifti, save_nifti
from vatsloc.formats.raw import check_affine
from vatsloc.frames import flip_field, reorient

LPS_VECTORS, RAS_VECTORS = 1007, 1006
STEP_MM = 2.0**-10
"""Written vectors are rounded to this: a thousandth of a millimetre halves the size of the compressed file."""


def write_field(path: Path, field: DisplacementField, axes: str | None = None) -> None:
    """Write LPS vectors with intent 1007, rounded to STEP_MM; `axes` reorders storage ("LPS")."""
    vectors, ras_from_ijk = np.asarray(field.vectors), field.ras_from_ijk
    if not np.isfinite(vectors).all():
        raise ValueError(f"field for {path.name} has displacements that are not finite")
    if axes is not None:
        vectors, ras_from_ijk = reorient(vectors, ras_from_ijk, axes)
    rounded = np.rint(flip_field(vectors) / np.float32(STEP_MM)) * np.float32(STEP_MM)
    image = nifti_image(rounded[:, :, :, None, :], ras_from_ijk)
    image.header.set_intent("vector")
    save_nifti(image, path)


@guarded("displacement field", "write it again")
def read_field(path: Path) -> DisplacementField:
    """Displacement field in RAS mm. Raises InputRefused when it is no 5-D vector image of intent 1006 or 1007."""
    image, intent = read_nifti(path), int(open_nifti(path)[1]["intent_code"])
    if image.values.ndim != 5 or image.values.shape[3:] != (1, 3):
        shape = " x ".join(str(n) for n in image.values.shape)
        raise InputRefused(f"{path} holds {shape} values, ni x nj x nk x 1 x 3 needed; write a displacement field.")
    if intent not in (LPS_VECTORS, RAS_VECTORS):
        raise InputRefused(f"{path} has intent {intent}, 1007 (LPS) or 1006 (RAS) needed; write it with ITK's intent.")
    check_affine(image.ras_from_ijk, path)
    vectors = np.ascontiguousarray(image.values[:, :, :, 0, :], dtype=np.float32)
    if not np.isfinite(vectors).all():
        raise InputRefused(f"{path} has displacements that are not finite; write the field again.")
    return DisplacementField(flip_field(vectors) if intent == LPS_VECTORS else vectors, image.ras_from_ijk)
