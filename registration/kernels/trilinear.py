"""The trilinear blend of a cell's eight voxels, with its slope: one formula for images, fields and warped blocks.

Only compiled code calls these. They are inlined before anything is compiled, so that each kernel rounds as if it had
written them out itself. What inlines them is cached by its own file's date: clear `__pycache__` after a change here.
"""

from __future__ import annotations

from numba import njit


@njit(inline="always")
def lower(x, n):
    """Voxel below a coordinate x within [0, n - 1], such that the next one exists where n > 1."""
    return max(min(int(x), n - 2), 0)


@njit(inline="always")
def between(p, q, t):
    """From p at t = 0 to q at t = 1."""
    return p * (1 - t) + q * t


@njit(inline="always")
def value(voxels, i, j, k, a, b, c):
    """Value a fraction (a, b, c) beyond voxel (i, j, k)."""
    v00 = between(voxels[i, j, k], voxels[i, j, k + 1], c)
    v01 = between(voxels[i, j + 1, k], voxels[i, j + 1, k + 1], c)
    v10 = between(voxels[i + 1, j, k], voxels[i + 1, j, k + 1], c)
    v11 = between(voxels[i + 1, j + 1, k], voxels[i + 1, j + 1, k + 1], c)
    return between(between(v00, v01, b), between(v10, v11, b), a)


@njit(inline="always")
def value_and_slope(voxels, i, j, k, a, b, c):
    """That value and its derivatives by a, b and c."""
    v000, v001 = voxels[i, j, k], voxels[i, j, k + 1]
    v010, v011 = voxels[i, j + 1, k], voxels[i, j + 1, k + 1]
    v100, v101 = voxels[i + 1, j, k], voxels[i + 1, j, k + 1]
    v110, v111 = voxels[i + 1, j + 1, k], voxels[i + 1, j + 1, k + 1]
    v00, v01 = between(v000, v001, c), between(v010, v011, c)
    v10, v11 = between(v100, v101, c), between(v110, v111, c)
    v0, v1 = between(v00, v01, b), between(v10, v11, b)
    v = between(v0, v1, a)
    by_a = v1 - v0
    by_b = between(v01 - v00, v11 - v10, a)
    by_c = between(between(v001 - v000, v011 - v010, b), between(v101 - v100, v111 - v110, b), a)
    return v, by_a, by_b, by_c
