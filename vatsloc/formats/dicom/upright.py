"""Slices of a tilted gantry, each shifted against the last, put onto an upright grid.

Such slices are parallel and evenly spaced, but the way from one to the next is not across them: their lattice is
sheared. Shifting every slice within its own plane makes it upright; nothing is interpolated between slices.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from registration.volume import Array

LEAST_SHEAR = 1e-3
MOST_TILT_DEGREES = 35.0
"""Gantries tilt by up to 30 degrees; what leans further is no tilt."""


def tilt_degrees(lps_from_ijk: Array) -> float:
    """Angle in degrees between the way from slice to slice and the normal of the slices."""
    step = lps_from_ijk[:3, 2]
    across = abs(float(_normal(lps_from_ijk) @ step))
    return float(np.degrees(np.arccos(np.clip(across / np.linalg.norm(step), 0, 1))))


def is_tilted(lps_from_ijk: Array) -> bool:
    """Whether a lattice is sheared as under a tilted gantry, by more than rounding and by no more than gantries do."""
    tilt = tilt_degrees(lps_from_ijk)
    return bool(np.sin(np.radians(tilt)) > LEAST_SHEAR and tilt <= MOST_TILT_DEGREES)


def upright(hu: Array, lps_from_ijk: Array, fill: float) -> tuple[Array, Array]:
    """Slices (nk, nj, ni) of a sheared lattice (4, 4), LPS mm, on the upright one that holds them all; that lattice.

    Each slice is shifted along its rows and columns, linearly between pixels; `fill` where it shows nothing.
    """
    nk, nj, ni = hu.shape
    along, down, step = lps_from_ijk[:3, :3].T
    shifts = np.outer(np.arange(nk), [step @ down / (down @ down), step @ along / (along @ along)])
    shifts = shifts.round(4)  # pixels; headers are rounded, and a whole pixel should not be blurred for that
    low, high = np.floor(shifts.min(axis=0)).astype(int), np.ceil(shifts.max(axis=0)).astype(int)
    out = np.empty((nk, *(np.array([nj, ni]) + high - low)), dtype=np.float32)
    for k in range(nk):
        ndimage.affine_transform(hu[k], np.ones(2), low - shifts[k], output=out[k], order=1, cval=fill)
    normal = _normal(lps_from_ijk)
    straight = lps_from_ijk.copy()
    straight[:3, 2] = normal * (normal @ step)
    straight[:3, 3] += low[1] * along + low[0] * down
    return out, straight


def _normal(lps_from_ijk: Array) -> Array:
    """Unit normal (3,) of the slices."""
    normal = np.cross(lps_from_ijk[:3, 0], lps_from_ijk[:3, 1])
    return np.asarray(normal / np.linalg.norm(normal))
