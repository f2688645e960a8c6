"""The fit of regional pressures to a lung's border. Ref: Fuerst et al., section 2.3, with derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.breathing.regional import Pressed, Thorax, press
from poro.errors import SolverError
from poro.mesh import TriSurface, closest_points
from poro.mesh.locate import Location, interpolate

SURFACE_ROUNDS = 16
PRIOR_MM_PER_KPA = 0.1
"""Root mean square distance that a pressure of 1 kPa is held to be worth."""
REACH_MM = 15.0
"""How far a step of the fit may move any node; halved after a step that helps nothing, doubled after one that does."""
REFUSALS, GAIN = 4, 0.005
"""The fit ends after so many steps in a row that help nothing, or with one that helps by less than that share."""


@dataclass(frozen=True)
class PressureFit:
    """Pressures (k,) kPa that bring the lung's border to the target. history: mean surface distance in mm, per round;
    evaluations: equilibria computed.
    """

    state: Pressed
    history: tuple[float, ...]
    evaluations: int


def fit_pressures(
    scene: Thorax,
    target: TriSurface,
    matched: tuple[Location, Array, Array] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> PressureFit:
    """Pressures by a trust region on the distances between the lung's border and the target's, both ways.

    matched: where landmarks lie in the lung (its own node numbers), their places (k, 3) at rest and in the target, for
    the fit that sees them (E2). Each round costs one equilibrium, whose factor also yields all derivatives.
    """
    k = scene.patches
    state = press(scene, np.zeros(k), np.zeros_like(scene.mesh.points))
    off = _distances(scene, target, state, matched)
    history, damping, reach, evaluations, refused = [off.mean_mm], 1e-2, REACH_MM, 1, 0
    for _ in range(SURFACE_ROUNDS):
        normal = off.slope.T @ off.slope
        regular = normal + damping * np.diag(np.diag(normal)) + 1e-9 * np.eye(k)
        step = np.linalg.solve(regular, -off.slope.T @ off.residual)
        motion = state.by_pressure @ step
        step = step * min(1.0, reach / max(float(np.linalg.norm(motion, axis=1).max()), 1e-9))
        evaluations += 1
        tried = balanced(scene, state.p + step, state.u + state.by_pressure @ step)
        there = None if tried is None else _distances(scene, target, tried, matched)
        if tried is None or there is None or there.cost >= off.cost:
            damping, reach, refused = max(10 * damping, 1e-2), reach / 2, refused + 1
            if refused == REFUSALS:
                break
            continue
        gain = 1 - there.cost / off.cost
        state, off, damping, reach, refused = tried, there, damping / 3, min(2 * reach, REACH_MM), 0
        history.append(off.mean_mm)
        say(f"mean surface distance {off.mean_mm:.2f} mm after {evaluations} equilibria")
        if gain < GAIN:
            break
    return PressureFit(state, tuple(history), evaluations)


def balanced(scene: Thorax, p: Array, start: Array, share: float = 1.0) -> Pressed | None:
    """The bodies under pressures p (k,) kPa, as `press`; None where they find no balance.

    Tissue that is linear in its own frame gives way without end under pressures far beyond any breath's.
    """
    try:
        found = press(scene, p, start, share)
    except (SolverError, np.linalg.LinAlgError):
        return None
    return found if found.settled else None


@dataclass(frozen=True)
class _Off:
    """Residuals (q,) of a fit, their derivatives (q, k) by the pressures, and the mean surface distance in mm."""

    residual: Array
    slope: Array
    mean_mm: float

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)


def _distances(
    scene: Thorax, target: TriSurface, state: Pressed, matched: tuple[Location, Array, Array] | None
) -> _Off:
    """How far the lung's border, or matched points, are from where they should be."""
    border = scene.lung.boundary
    moved = border.moved(border.points + state.u[border.nodes])
    there, back = closest_points(target, moved.points), closest_points(moved, target.points)
    change = state.by_pressure[border.nodes]
    at_back = np.einsum("qk,qkdp->qdp", back.barycentric, change[border.triangles[back.triangle]])
    normal = np.concatenate([target.normals[there.triangle], target.node_normals])
    gap = np.concatenate([moved.points - there.points, back.points - target.points])
    root = np.sqrt(np.concatenate([moved.node_areas / moved.areas.sum(), target.node_areas / target.areas.sum()]) / 2)
    along = np.einsum("qd,qd->q", gap, normal)
    robust = 1 / np.sqrt(1 + (along / 20.0) ** 2)
    slope = np.einsum("qd,qdp->qp", normal, np.concatenate([change, at_back]))
    residual, slope = root * robust * along, (root * robust)[:, None] * slope
    # Patches that the border hardly tells apart would run away against each other.
    k = len(state.p)
    residual = np.concatenate([residual, PRIOR_MM_PER_KPA * state.p])
    slope = np.concatenate([slope, PRIOR_MM_PER_KPA * np.eye(k)])
    mean = float(np.average(np.abs(there.distance), weights=moved.node_areas))
    if matched is not None:
        where, rest, goal = matched
        off = rest + interpolate(where, state.u[: len(scene.lung.points)]) - goal
        by = interpolate(where, state.by_pressure[: len(scene.lung.points)])
        weight = 1 / np.sqrt(len(rest))
        residual = np.concatenate([residual, weight * off.ravel()])
        slope = np.concatenate([slope, weight * by.reshape(-1, by.shape[2])])
    return _Off(residual, slope, mean)
