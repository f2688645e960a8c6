"""Fit of the poroelastic lung to the deflated anatomy, by bounded robust least squares. Ref: Alvarez 2021, sec. 7.3."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from poro.arrays import Array
from poro.collapse.model import PoroSystem, Theta
from poro.collapse.solution import PoroState, PoroStatus, sensitivity
from poro.fit.observations import Residuals, Target
from poro.fit.problem import FitProblem, FitSettings, bounds
from poro.fit.trust_region import FitStep, descend


class FitStatus(Enum):
    """How a fit ended."""

    CONVERGED = "no step lowered the cost by a thousandth any more, or promised a tenth of that"
    STOPPED = "the steps ran out before the cost converged"
    CONTACT = "contact did not converge at the best parameters"


@dataclass(frozen=True)
class Fit:
    """Best parameters and how well they are known.

    covariance: (3 + k, 3 + k) of Theta.vector(); sensitivity: (n, 3, 3 + k); surface_rms_mm, keypoint_rms_mm: weighted
    residuals; history: of the best start; costs: (starts,) where each ended; free: (3 + k,) bool, what might move.
    """

    theta: Theta
    state: PoroState
    covariance: Array
    sensitivity: Array
    surface_rms_mm: float
    keypoint_rms_mm: float
    history: tuple[FitStep, ...]
    costs: Array
    status: FitStatus
    free: Array


def fit_collapse(system: PoroSystem, target: Target, settings: FitSettings | None = None) -> Fit:
    """Parameters whose deflated lung comes closest to the target; the best of the deterministic starts.

    Raises ValueError when the target holds nothing of positive weight.
    """
    settings = settings or FitSettings()
    if not target.weights.any() and not target.keypoint_weights.any():
        raise ValueError("target holds no point of positive weight; give surface points or matched inner points")
    problem = FitProblem.of(system, target, settings)
    ends = []
    for start in settings.starts:
        modes = start[3:] or np.zeros(len(system.modes))
        ends.append(descend(problem, np.array([np.log10(start[0]), *start[1:3], *modes])))
    best = min(ends, key=lambda end: end.cost)
    status = FitStatus.CONVERGED if best.converged else FitStatus.STOPPED
    if best.state.status is PoroStatus.NOT_CONVERGED:
        status = FitStatus.CONTACT
    du = sensitivity(system, best.state)
    rows = problem.observer.residuals(best.state.u)
    return Fit(
        theta=Theta.of(best.theta),
        state=best.state,
        covariance=_covariance(problem, rows, du, best.theta),
        sensitivity=du,
        surface_rms_mm=_rms(problem, rows, rows.surface),
        keypoint_rms_mm=_rms(problem, rows, ~rows.surface),
        history=best.history,
        costs=np.array([end.cost for end in ends]),
        status=status,
        free=problem.free,
    )


def _covariance(problem: FitProblem, rows: Residuals, du: Array, theta: Array) -> Array:
    """Gauss-Newton covariance, widened by the misfit where the model explains less than the data's own noise would
    leave.
    """
    whitening = problem.whiten(rows)
    normal, _ = problem.normal_equations(rows, du, theta)
    weight = whitening**2 * problem.influence(rows)
    freedom = max(float(weight.sum() * problem.settings.surface_sigma_mm**2) - len(theta), 1.0)
    misfit = max(1.0, float((weight * rows.value**2).sum()) / freedom)
    low, high = bounds(problem.system)
    width = np.where(np.isfinite(high - low), high - low, 1.0)
    # The box itself is knowledge: without it a parameter that the data do not see would have no variance at all.
    normal[np.diag_indices(3)] += misfit * 12 / width[:3] ** 2
    return misfit * np.linalg.inv(normal)


def _rms(problem: FitProblem, rows: Residuals, chosen: Array) -> float:
    """Root mean square in mm of the believed part of the surface or of the inner points."""
    if not chosen.any():
        return 0.0
    weight = rows.weight[chosen] * problem.influence(rows)[chosen]
    axes = len(rows.value[chosen]) / max(len(np.unique(rows.group[chosen])), 1)
    return float(np.sqrt(axes * (weight * rows.value[chosen] ** 2).sum() / max(weight.sum(), 1e-30)))
