"""A result as OpenIGTLink messages, packed. Everything is RAS mm in the deflated scan's frame, as 3D Slicer takes it.

Ref: OpenIGTLink protocol, version 2: POINT, POLYDATA, TRANSFORM, IMAGE, STRING.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.dicomout.finding import Finding, read_finding
from vatsloc.errors import CaseError
from vatsloc.formats.casefile import FILE_NAME, read_case_file
from vatsloc.formats.images import read_volume
from vatsloc.formats.transforms import read_tfm
from vatsloc.results import RIGID_DEFLATED_FROM_INFLATED, RIGID_INFLATED_FROM_CT, case_of

NODULE, ELLIPSOID, POSE, SCAN = "nodule", "ellipsoid95", "DeflatedFromCT", "deflated"
TRUST, PATIENT = "trust", "patient"
RINGS, SECTORS = 16, 32
"""Of the ellipsoid's surface."""
YELLOW, RED = (240, 228, 66, 255), (213, 94, 0, 255)
MOST_VOXELS = 65535
"""Along an axis, by the protocol."""


def messages_of(result: Path, patient: str = "") -> list[bytes]:
    """Packed messages of a results folder; the scan is left out where its case is not there any more.

    POINT `nodule`, TRANSFORM `DeflatedFromCT` (the spine's pose, CT to deflated scan), STRING `trust`, IMAGE
    `deflated`, POLYDATA `ellipsoid95`, and STRING `patient` where the patient's ID is given. Raises CaseError where the
    folder is no result or pyigtl is not installed.
    """
    require_pyigtl()
    import pyigtl

    finding = read_finding(result)
    pose = read_tfm(result / RIGID_DEFLATED_FROM_INFLATED) @ read_tfm(result / RIGID_INFLATED_FROM_CT)
    made: list[Any] = [
        pyigtl.PointMessage(
            positions=[finding.centre_ras.tolist()],
            names=[NODULE if not finding.failed else f"{NODULE}: DO NOT TRUST"],
            rgba_colors=list(RED if finding.failed else YELLOW),
            device_name=NODULE,
        ),
        pyigtl.TransformMessage(pose, device_name=POSE),
        pyigtl.StringMessage(trust(finding), device_name=TRUST),
    ]
    scan = _scan(result)
    if scan is not None:
        hu, ras_from_ijk = scan
        image = np.ascontiguousarray(np.rint(hu).clip(-32768, 32767).astype("<i2").transpose(2, 1, 0))
        made.append(pyigtl.ImageMessage(image, ras_from_ijk, "ras", device_name=SCAN))
    if finding.semi_axes_ras is not None:
        points, triangles = ellipsoid_surface(finding.centre_ras, finding.semi_axes_ras)
        cells = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
        made.append(pyigtl.PolyDataMessage(points=points, polygons=cells, device_name=ELLIPSOID))
    if patient:
        made.append(pyigtl.StringMessage(patient, device_name=PATIENT))
    return [message.pack() for message in made]


def trust(finding: Finding) -> str:
    """Whether to trust the answer, in words."""
    if not finding.failed:
        return "all quality gates passed"
    return "DO NOT TRUST: " + " ".join(str(finding.gates[name]["says"]) for name in finding.failed)


def ellipsoid_surface(centre: Array, semi_axes: Array) -> tuple[Array, Array]:
    """Points (n, 3) mm and triangles (m, 3), outward, of an ellipsoid with semi-axes in rows."""
    theta = np.linspace(0, np.pi, RINGS + 1)[1:-1, None]
    phi = np.linspace(0, 2 * np.pi, SECTORS, endpoint=False)[None]
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)
    unit = np.concatenate([[[0, 0, 1.0]], ring.reshape(-1, 3), [[0, 0, -1.0]]])
    last, triangles = len(unit) - 1, []
    for s in range(SECTORS):
        t = (s + 1) % SECTORS
        triangles += [(0, 1 + s, 1 + t), (last, last - SECTORS + t, last - SECTORS + s)]
        for r in range(RINGS - 2):
            a, b, c, d = (1 + (r + dr) * SECTORS + x for dr, x in ((0, s), (0, t), (1, s), (1, t)))
            triangles += [(a, c, b), (b, c, d)]
    mirrored = np.linalg.det(semi_axes) < 0
    faces = np.array(triangles)
    return centre + unit @ semi_axes, faces[:, ::-1] if mirrored else faces


def require_pyigtl() -> None:
    """Raise CaseError where the extra is not installed."""
    if find_spec("pyigtl") is None:
        raise CaseError('--openigtlink needs pyigtl; install it by: pip install "vatsloc[navigation]".')


def _scan(result: Path) -> tuple[Array, Array] | None:
    """The deflated scan of a result's case, None where it is gone."""
    case = case_of(result)
    if case is None or not (case / FILE_NAME).is_file():
        return None
    images = read_case_file(case).images
    path = case / (images.cbct_deflated or "")
    if images.cbct_deflated is None or not path.exists():
        return None
    volume = read_volume(path, images.cbct_deflated_series)
    return (volume.hu, volume.ras_from_ijk) if max(volume.hu.shape) <= MOST_VOXELS else None
