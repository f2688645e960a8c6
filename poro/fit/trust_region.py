"""Fit of the poroelastic lung to the deflated anatomy, by bounded robust least squares. Ref: Alvarez 2021, sec. 7.3."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from poro.collapse.model import (
    DIAPHRAGM_BOUNDS_MM,
    KAPPA_B_BOUNDS,
    PHI_BOUNDS,
    PoroState,
    PoroStatus,
    PoroSystem,
    Theta,
    sensitivity,
    solve,
)
from poro.fit.observations import Observer, Residuals, Target, independence
from poro.mesh.locate import interpolate, locate
from poro.mesh.tetmesh import Array

CHI2_95_3D = 7.814728  # 95 % quantile of chi-squared with three degrees of freedom
# Longest step in (log10 kappa_b, phi, d_diaph_mm): beyond it the contact seen from here says nothing.
REACH = np.array([1.0, 0.2, 8.0])
DAMPING = 1e-6  # of the normal equations' diagonal, against directions that no datum sees
SMALLEST = 1e-3  # share of the reach at which a refused step ends the descent
# Mean of log10 kappa_b over five patients, -7.96 with a spread of 0.77. Ref: Alvarez 2021, table 3.
USUAL_LOG_KAPPA_B = -8.0


@dataclass(frozen=True)
class FitSettings:
    """How a fit weighs its data and when it stops.

    surface_sigma_mm, keypoint_sigma_mm: standard deviations of one observation; correlation_mm: surface points closer
    than this count as one; robust: residual, in standard deviations, from which influence falls off (Cauchy),
    infinite for none; plain: the paper's nearest-node cost; free: which entries of theta and the modes may move, all
    when None; starts: (kappa_b, phi, d_diaph_mm, amplitudes of the modes or none of them); kappa_decades: standard
    deviation of a prior on log10 kappa_b, twice the spread over the paper's patients, infinite for none: below 1e-11
    the pressure drop is a thousandth of its largest and no datum tells one kappa_b from another.
    """

    surface_sigma_mm: float = 2.0
    keypoint_sigma_mm: float = 2.0
    correlation_mm: float = 15.0
    robust: float = 3.0
    plain: bool = False
    free: tuple[bool, ...] | None = None
    max_steps: int = 30
    tolerance: float = 1e-3
    starts: tuple[tuple[float, ...], ...] = ((1e-8, 0.8, 0.0),)
    kappa_decades: float = 1.5


class FitStatus(Enum):
    """How a fit ended."""

    CONVERGED = "no step lowered the cost by a thousandth any more, or promised a tenth of that"
    STOPPED = "the steps ran out before the cost settled"
    CONTACT = "the forward solution at the best parameters did not settle"


@dataclass(frozen=True)
class FitStep:
    """One accepted or refused trial: cost, share of the reach that it was allowed, theta as a vector."""

    cost: float
    radius: float
    theta: Array
    accepted: bool


@dataclass(frozen=True)
class Fit:
    """Best parameters and how well they are known.

    covariance: (3 + k, 3 + k) of Theta.vector(); sensitivity: (n, 3, 3 + k); surface_rms_mm, keypoint_rms_mm: weighted
    residuals; spread: (starts, 3 + k) where every start ended; costs: (starts,); free: (3 + k,) bool, what might move.
    """

    theta: Theta
    state: PoroState
    covariance: Array
    sensitivity: Array
    surface_rms_mm: float
    keypoint_rms_mm: float
    history: tuple[FitStep, ...]
    spread: Array
    costs: Array
    status: FitStatus
    free: Array


@dataclass(frozen=True)
class _Problem:
    system: PoroSystem
    observer: Observer
    settings: FitSettings
    scale: Array

    def whiten(self, rows: Residuals) -> Array:
        """Factor (r,) that turns millimetres into standard deviations of independent observations."""
        sigma = np.where(rows.surface, self.settings.surface_sigma_mm, self.settings.keypoint_sigma_mm)
        return np.sqrt(rows.weight * self.scale[rows.group]) / sigma

    def cost(self, rows: Residuals, whitening: Array, theta: Array) -> float:
        """Half the robust sum of squares plus the priors'."""
        return float(self._loss(rows, whitening).sum() + 0.5 * self.prior() @ (theta - self.usual) ** 2)

    def influence(self, rows: Residuals) -> Array:
        """Weight (r,) of every row by the Cauchy loss of its observation."""
        c = self.settings.robust
        return 1 / (1 + self._squares(rows)[rows.group] / c**2)

    def _squares(self, rows: Residuals) -> Array:
        sigma = np.where(rows.surface, self.settings.surface_sigma_mm, self.settings.keypoint_sigma_mm)
        return np.bincount(rows.group, (rows.value / sigma) ** 2, len(self.scale))

    def _loss(self, rows: Residuals, whitening: Array) -> Array:
        c, square = self.settings.robust, self._squares(rows)
        sigma = np.where(rows.surface, self.settings.surface_sigma_mm, self.settings.keypoint_sigma_mm)
        trust = np.zeros(len(self.scale))
        trust[rows.group] = (whitening * sigma) ** 2
        return 0.5 * trust * (c**2 * np.log1p(square / c**2) if np.isfinite(c) else square)

    @property
    def free(self) -> Array:
        """Parameters (3 + k,) bool that may move."""
        every = np.ones(3 + len(self.mode_sigmas), bool)
        return every if self.settings.free is None else np.array(self.settings.free)

    @property
    def mode_sigmas(self) -> Array:
        """Prior standard deviations (k,) of the modes' amplitudes."""
        return np.array([mode.sigma for mode in self.system.modes])

    def prior(self) -> Array:
        """Diagonal (3 + k,) of the prior's inverse covariance."""
        return np.concatenate([[self.settings.kappa_decades**-2.0, 0, 0], self.mode_sigmas**-2.0])

    @property
    def usual(self) -> Array:
        """Mean (3 + k,) of the prior, where there is one."""
        return np.concatenate([[USUAL_LOG_KAPPA_B, 0, 0], np.zeros(len(self.mode_sigmas))])


def bounds(system: PoroSystem) -> tuple[Array, Array]:
    """Lower and upper bounds of Theta.vector()."""
    wide = np.full(len(system.modes), np.inf)
    low = [np.log10(KAPPA_B_BOUNDS[0]), PHI_BOUNDS[0], DIAPHRAGM_BOUNDS_MM[0]]
    high = [np.log10(KAPPA_B_BOUNDS[1]), PHI_BOUNDS[1], DIAPHRAGM_BOUNDS_MM[1]]
    return np.concatenate([low, -wide]), np.concatenate([high, wide])


def fit(
    system: PoroSystem,
    target: Target,
    settings: FitSettings | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Fit:
    """Parameters whose deflated lung comes closest to the target; the best of the deterministic starts.

    Raises ValueError when the target holds nothing of positive weight.
    """
    settings = settings or FitSettings()
    if not target.weights.any() and not target.keypoint_weights.any():
        raise ValueError("target holds no point of positive weight; give surface points or matched inner points")
    observer = Observer(system.mesh, target, settings.plain)
    problem = _Problem(system, observer, settings, _worth(target, settings.correlation_mm))
    runs = []
    for number, start in enumerate(settings.starts):
        if progress:
            progress("fit", number / len(settings.starts))
        modes = start[3:] or np.zeros(len(system.modes))
        runs.append(_descend(problem, np.array([np.log10(start[0]), *start[1:3], *modes])))
    theta, state, history, settled = min(runs, key=lambda run: run[2][-1].cost)
    status = FitStatus.CONVERGED if settled else FitStatus.STOPPED
    if state.status is PoroStatus.NOT_SETTLED:
        status = FitStatus.CONTACT
    du = sensitivity(system, state)
    rows = observer.residuals(state.u)
    covariance = _covariance(problem, rows, du, theta)
    return Fit(
        theta=Theta.of(theta),
        state=state,
        covariance=covariance,
        sensitivity=du,
        surface_rms_mm=_rms(problem, rows, rows.surface),
        keypoint_rms_mm=_rms(problem, rows, ~rows.surface),
        history=history,
        spread=np.array([run[0] for run in runs]),
        costs=np.array([run[2][-1].cost for run in runs]),
        status=status,
        free=problem.free,
    )


def point_covariance(
    result: Fit, system: PoroSystem, points: Array, unexplained_mm: float | Array | None = None
) -> Array:
    """Covariance (k, 3, 3) mm2 of where points (k, 3) lie after the collapse.

    The parameters' covariance carried to the points, plus the standard deviation per axis, one or (k,), of what no
    parameter explains: by default what the fit leaves at the points it sees; after a correction give its held-out
    misfit.
    """
    du = interpolate(locate(system.mesh, np.atleast_2d(points)), result.sensitivity)
    left = max(result.surface_rms_mm, result.keypoint_rms_mm / np.sqrt(3))
    unexplained = np.atleast_1d(left if unexplained_mm is None else unexplained_mm)
    carried = np.einsum("kip,pq,kjq->kij", du, result.covariance, du, optimize=True)
    return np.asarray(carried + unexplained[:, None, None] ** 2 * np.eye(3))


def ellipsoid95(covariance: Array) -> tuple[Array, Array]:
    """Semi-axes (k, 3) mm, longest first, and their directions (k, 3, 3) in rows, of the ellipsoids that hold points of
    covariance (k, 3, 3) mm2 with 95 %.
    """
    values, vectors = np.linalg.eigh(covariance)
    return np.sqrt(CHI2_95_3D * values[:, ::-1]), vectors[:, :, ::-1].swapaxes(1, 2)


def _descend(problem: _Problem, theta: Array) -> tuple[Array, PoroState, tuple[FitStep, ...], bool]:
    """Gauss-Newton in a box that shrinks when a step is refused; weights are frozen at every accepted state.

    Ref: Conn, Gould & Toint 2000 (trust regions).
    """
    low, high = bounds(problem.system)
    free = problem.free
    reach = np.concatenate([REACH, 3 * problem.mode_sigmas])
    theta = np.clip(theta, low, high)
    state = solve(problem.system, Theta.of(theta))
    rows = problem.observer.residuals(state.u)
    cost = problem.cost(rows, problem.whiten(rows), theta)
    radius = 1.0
    history = [FitStep(cost, radius, theta, True)]
    normal, slope = _normal_equations(problem, rows, sensitivity(problem.system, state), theta)
    for _ in range(problem.settings.max_steps):
        near = np.maximum(low, theta - radius * reach), np.minimum(high, theta + radius * reach)
        step = _bounded_step(normal, slope, theta, *near, free)
        promised = -(slope + 0.5 * normal @ step) @ step
        if promised <= 0.1 * problem.settings.tolerance * cost:
            return theta, state, tuple(history), True
        trial_state = solve(problem.system, Theta.of(theta + step), state)
        trial_rows = problem.observer.residuals(trial_state.u)
        trial_cost = problem.cost(trial_rows, problem.whiten(trial_rows), theta + step)
        accepted = trial_cost < cost and trial_state.status is not PoroStatus.NOT_SETTLED
        history.append(FitStep(trial_cost if accepted else cost, radius, theta + step, accepted))
        if not accepted:
            radius = 0.3 * min(radius, float(np.abs(step / reach).max()))
            if radius < SMALLEST:
                return theta, state, tuple(history), True
            continue
        gain = (cost - trial_cost) / cost
        theta, state, rows, cost = theta + step, trial_state, trial_rows, trial_cost
        # A step that the whole box cut short says little of what the next one may gain; in a small one all steps are.
        if gain < problem.settings.tolerance and (radius < 1 or (np.abs(step) < 0.99 * reach).all()):
            return theta, state, tuple(history), True
        radius = min(1.0, 3 * radius)
        normal, slope = _normal_equations(problem, rows, sensitivity(problem.system, state), theta)
    return theta, state, tuple(history), False


def _normal_equations(problem: _Problem, rows: Residuals, du: Array, theta: Array) -> tuple[Array, Array]:
    jacobian = rows.derivative(du)
    weight = problem.whiten(rows) ** 2 * problem.influence(rows)
    prior = problem.prior()
    normal = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
    return normal, jacobian.T @ (weight * rows.value) + prior * (theta - problem.usual)


def _bounded_step(normal: Array, slope: Array, theta: Array, low: Array, high: Array, free: Array) -> Array:
    """Gauss-Newton step; entries that would leave the box stop at its wall and the others are solved again."""
    step = np.zeros_like(theta)
    moving = free.copy()
    damped = normal + DAMPING * np.diag(np.maximum(np.diag(normal), 1e-12 * np.diag(normal).max()))
    for _ in range(len(theta)):
        inner = np.flatnonzero(moving)
        if len(inner) == 0:
            break
        held = ~moving
        right = -slope[inner] - damped[np.ix_(inner, np.flatnonzero(held))] @ step[held]
        step[inner] = np.linalg.solve(damped[np.ix_(inner, inner)], right)
        outside = moving & ((theta + step < low) | (theta + step > high))
        if not outside.any():
            break
        step[outside] = np.clip(theta + step, low, high)[outside] - theta[outside]
        moving &= ~outside
    return step


def _worth(target: Target, correlation_mm: float) -> Array:
    """Independent observations (t + k,) that every surface and inner point is worth."""
    return np.concatenate([independence(target.points, correlation_mm), np.ones(len(target.inflated))])


def _covariance(problem: _Problem, rows: Residuals, du: Array, theta: Array) -> Array:
    """Gauss-Newton covariance, widened by the misfit where the model explains less than the data's own noise would
    leave.
    """
    whitening = problem.whiten(rows)
    normal, _ = _normal_equations(problem, rows, du, theta)
    weight = whitening**2 * problem.influence(rows)
    freedom = max(float(weight.sum() * problem.settings.surface_sigma_mm**2) - len(theta), 1.0)
    misfit = max(1.0, float((weight * rows.value**2).sum()) / freedom)
    low, high = bounds(problem.system)
    width = np.where(np.isfinite(high - low), high - low, 1.0)
    # The box itself is knowledge: without it a parameter that the data do not see would have no variance at all.
    normal[np.diag_indices(3)] += misfit * 12 / width[:3] ** 2
    return misfit * np.linalg.inv(normal)


def _rms(problem: _Problem, rows: Residuals, chosen: Array) -> float:
    """Root mean square in mm of the believed part of the surface or of the inner points."""
    if not chosen.any():
        return 0.0
    weight = rows.weight[chosen] * problem.influence(rows)[chosen]
    axes = len(rows.value[chosen]) / max(len(np.unique(rows.group[chosen])), 1)
    return float(np.sqrt(axes * (weight * rows.value[chosen] ** 2).sum() / max(weight.sum(), 1e-30)))
