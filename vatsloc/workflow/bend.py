"""A fissure's sheet bent to where keypoints and gas say that it lies.

Six numbers tell roughly where a lung came apart. They do not hold a real fissure: tissue between it and the sheet would
go with the wrong lobe. So the sheet is given a height above itself, a uniform cubic B-spline in its own plane, which
bends as little as keypoints on either side of it and gas along it allow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from registration.volume import Array

STEP_MM = 20.0
"""Between the spline's coefficients."""
REACH = 8
"""Coefficients to either side of the hilum."""
STIFFNESS, HELD = 0.1, 1e-4
"""Weights of the height's second differences and of its coefficients, beside a keypoint that lies 1 mm wrong. Chosen on
twin-c and twin-f; a third and three times as much stiffness change what lies on the wrong side by 3 to 12 %."""
CLEARANCE_MM = 1.0
"""From the sheet, where a keypoint costs nothing."""
GAS_MM, GAS_WEIGHT = 2.5, 0.1
"""Standard deviation of where gas came from, and what one of its points, one for some 9 mm2 of surface, weighs beside a
keypoint."""
STRAY_MM = 5.0
"""Points farther off lose influence (Cauchy)."""
ROUNDS = 12


@dataclass(frozen=True)
class Bend:
    """Height over a plane. centre: (3,) RAS mm; axes: (2, 3) unit vectors in the plane; coefficients: (k, k) mm."""

    centre: Array
    axes: Array
    coefficients: Array

    def height(self, points: Array) -> Array:
        """Height (n,) mm over the plane at the feet of points (n, 3)."""
        first, second = _basis(points, self.centre, self.axes)
        return np.asarray(np.einsum("ni,ij,nj->n", first, self.coefficients, second))


def bend_to(centre: Array, axes: Array, keypoints: tuple[Array, Array, Array], gas: tuple[Array, Array]) -> Bend:
    """The height that leaves keypoints on their sides and passes through gas. centre, axes: as in `Bend`; keypoints:
    points (n, 3) mm, their signed distances (n,) mm from the sheet and sides (n,), +1 or -1; gas: points (k, 3) and
    distances (k,).
    """
    (points, above, side), (airy, off) = keypoints, gas
    told, along = (_products(_basis(x, centre, axes)) for x in (points, airy))
    stiff = _stiffness()
    height: Array = np.zeros(len(stiff))
    for _ in range(ROUNDS):
        short = np.maximum(CLEARANCE_MM - side * (above - told @ height), 0)
        weight = (short > 0) / (1 + (short / STRAY_MM) ** 2)
        sure = GAS_WEIGHT / GAS_MM**2 / (1 + ((off - along @ height) / STRAY_MM) ** 2)
        normal = stiff + (told.T * weight) @ told + (along.T * sure) @ along
        height = np.linalg.solve(normal, (told.T * weight) @ (above - CLEARANCE_MM * side) + (along.T * sure) @ off)
    return Bend(centre, axes, height.reshape(2 * REACH + 1, -1))


def _basis(points: Array, centre: Array, axes: Array) -> tuple[Array, Array]:
    """The splines' values (n, k) along both axes; a point beyond the last takes what stands there."""
    if len(points) == 0:
        return np.zeros((0, 2 * REACH + 1)), np.zeros((0, 2 * REACH + 1))
    knots = np.arange(-REACH - 2.0, REACH + 2.5)
    along = np.clip((points - centre) @ axes.T / STEP_MM, knots[3], knots[-4])
    first, second = (BSpline.design_matrix(x, knots, 3).toarray() for x in along.T)
    return first, second


def _products(basis: tuple[Array, Array]) -> Array:
    first, second = basis
    return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(first), first.shape[1] * second.shape[1]))


def _stiffness() -> Array:
    """Quadratic form of the second differences of (k, k) coefficients: a thin plate's energy."""
    one = np.eye(2 * REACH + 1)
    slope, curve = (difference.T @ difference for difference in (np.diff(one, 1, 0), np.diff(one, 2, 0)))
    plate = np.kron(curve, one) + np.kron(one, curve) + 2 * np.kron(slope, slope)
    return np.asarray(STIFFNESS * plate + HELD * np.eye(len(plate)))
