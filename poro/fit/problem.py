"""The least-squares problem of a fit: residuals in standard deviations, robust, with priors and bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.collapse.model import DIAPHRAGM_BOUNDS_MM, KAPPA_B_BOUNDS, PHI_BOUNDS, PoroSystem
from poro.fit.observations import Observer, Residuals, Target, independence

# Longest step in (log10 kappa_b, phi, d_diaph_mm): beyond it the contact seen from here says nothing.
STEP_SCALE = np.array([1.0, 0.2, 8.0])
# Mean of log10 kappa_b over five patients, -7.96 with a spread of 0.77. Ref: Alvarez 2021, table 3.
PRIOR_LOG_KAPPA_B = -8.0


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


@dataclass(frozen=True)
class FitProblem:
    """What is minimized over theta. independent: (t + k,) observations that every surface and inner point is worth."""

    system: PoroSystem
    observer: Observer
    settings: FitSettings
    independent: Array

    @staticmethod
    def of(system: PoroSystem, target: Target, settings: FitSettings) -> FitProblem:
        """The problem of bringing a system's collapse to a target."""
        surface = independence(target.points, settings.correlation_mm)
        independent = np.concatenate([surface, np.ones(len(target.inflated))])
        return FitProblem(system, Observer(system.mesh, target, settings.plain), settings, independent)

    def whiten(self, rows: Residuals) -> Array:
        """Factor (r,) that turns millimetres into standard deviations of independent observations."""
        return np.sqrt(rows.weight * self.independent[rows.group]) / self._sigma(rows)

    def cost(self, rows: Residuals, whitening: Array, theta: Array) -> float:
        """Half the robust sum of squares, weighted by `whitening` (r,), plus the priors'."""
        return float(self._loss(rows, whitening).sum() + 0.5 * self.prior() @ (theta - self.prior_mean) ** 2)

    def influence(self, rows: Residuals) -> Array:
        """Weight (r,) of every row by the Cauchy loss of its observation."""
        c = self.settings.robust
        return 1 / (1 + self._squares(rows)[rows.group] / c**2)

    def normal_equations(self, rows: Residuals, du: Array, theta: Array) -> tuple[Array, Array]:
        """Gauss-Newton matrix (3 + k, 3 + k) and gradient (3 + k,) of the cost, for derivatives du (n, 3, 3 + k)."""
        jacobian = rows.derivative(du)
        weight = self.whiten(rows) ** 2 * self.influence(rows)
        prior = self.prior()
        normal = jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior)
        return normal, jacobian.T @ (weight * rows.value) + prior * (theta - self.prior_mean)

    def _sigma(self, rows: Residuals) -> Array:
        return np.where(rows.surface, self.settings.surface_sigma_mm, self.settings.keypoint_sigma_mm)

    def _squares(self, rows: Residuals) -> Array:
        return np.bincount(rows.group, (rows.value / self._sigma(rows)) ** 2, len(self.independent))

    def _loss(self, rows: Residuals, whitening: Array) -> Array:
        c, square = self.settings.robust, self._squares(rows)
        trust = np.zeros(len(self.independent))
        trust[rows.group] = (whitening * self._sigma(rows)) ** 2
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

    @property
    def step_scale(self) -> Array:
        """Longest step (3 + k,) of every parameter."""
        return np.concatenate([STEP_SCALE, 3 * self.mode_sigmas])

    def prior(self) -> Array:
        """Diagonal (3 + k,) of the prior's inverse covariance."""
        return np.concatenate([[self.settings.kappa_decades**-2.0, 0, 0], self.mode_sigmas**-2.0])

    @property
    def prior_mean(self) -> Array:
        """Mean (3 + k,) of the prior, where there is one."""
        return np.concatenate([[PRIOR_LOG_KAPPA_B, 0, 0], np.zeros(len(self.mode_sigmas))])


def bounds(system: PoroSystem) -> tuple[Array, Array]:
    """Lower and upper bounds of Theta.vector()."""
    wide = np.full(len(system.modes), np.inf)
    low = [np.log10(KAPPA_B_BOUNDS[0]), PHI_BOUNDS[0], DIAPHRAGM_BOUNDS_MM[0]]
    high = [np.log10(KAPPA_B_BOUNDS[1]), PHI_BOUNDS[1], DIAPHRAGM_BOUNDS_MM[1]]
    return np.concatenate([low, -wide]), np.concatenate([high, wide])
