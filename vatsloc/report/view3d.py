"""What the page's scripts draw from: slices, the lung's surface before and after, the nodule, landmarks, colours."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from registration.volume import Array
from vatsloc.formats.meshes import Surface
from vatsloc.report.data import LUNG, MESH, NODULE, ReportData
from vatsloc.report.stack import Stack
from vatsloc.report.words import WORDS

LOOK_DEGREES = {"right": -60.0, "left": 60.0}
"""Turn from the front towards the operated side: about where a thoracoscope looks from."""
TILT_DEGREES = 12.0
_SHORT = {WORDS[name]: WORDS[f"{name}_short"] for name in ("apex", "lowest", "anterior", "posterior")}


def scene(data: ReportData, stacks: Sequence[Stack]) -> dict[str, Any]:
    """Plain values for JSON. Points in RAS mm; surfaces as base64 of float32 points and uint32 triangles."""
    motion, nodule = data.motion, data.nodule
    return {
        "stacks": [stack.as_json() for stack in stacks],
        "colours": {"nodule": NODULE, "lung": LUNG, "wall": MESH},
        "look": {"turn": LOOK_DEGREES.get(str(data.run.get("side")), 0.0), "tilt": TILT_DEGREES},
        "motion": None
        if motion is None
        else {
            "triangles": _packed(motion.triangles, "<u4"),
            "before": _packed(motion.before, "<f4"),
            "after": _packed(motion.after, "<f4"),
            "wall": _surface(motion.wall),
        },
        "nodule": {
            "before": None if motion is None else _rounded(motion.nodule_before),
            "after": _rounded(nodule.centre_ras),
            "ellipsoid": None if nodule.ellipsoid is None else _rounded(nodule.ellipsoid),
            "foot": None if data.nearest_surface_ras is None else _rounded(data.nearest_surface_ras),
        },
        "landmarks": [
            {"name": _SHORT[mark.name], "at": _rounded(mark.at_ras)} for mark in data.landmarks if mark.visible
        ],
        "words": {name: WORDS[f"mark_{name}"] for name in ("nodule", "inflated")},
    }


def _surface(surface: Surface) -> dict[str, str]:
    return {"points": _packed(surface.points_ras, "<f4"), "triangles": _packed(surface.triangles, "<u4")}


def _packed(values: Array, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _rounded(values: Array) -> Any:
    return np.round(np.asarray(values, dtype=float), 3).tolist()
