"""What the data tell of each parameter of a fit, and where they leave a valley."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poro.arrays import Array
from poro.collapse.model import PoroSystem
from poro.fit.collapse_fit import Fit
from poro.fit.problem import STEP_SCALE, bounds

THETA_NAMES = ("log10 kappa_b", "phi", "d_diaph_mm")
AT_BOUND = 1e-3  # share of a parameter's range within which it counts as at its bound


@dataclass(frozen=True)
class Identifiability:
    """How well p parameters are held, by data and priors together.

    sigma: (p,) standard deviations; correlation: (p, p); singular: (p,) of the whitened Jacobian, largest first, the
    parameters in units of a fit's longest step (10-fold kappa_b, 0.2 of phi, 8 mm, 3 sigma of a mode), so that below 1
    a whole such step changes nothing that can be seen; valley: (p,) unit direction of the smallest, in these units;
    at_bound: names of the parameters that ended at a bound.
    """

    names: tuple[str, ...]
    sigma: Array
    correlation: Array
    singular: Array
    valley: Array
    at_bound: tuple[str, ...]

    def entry(self) -> dict[str, object]:
        """For a record: what is said here, by name."""
        return {
            "parameters": list(self.names),
            "sigma": self.sigma,
            "correlation": self.correlation,
            "singular_values": self.singular,
            "valley": dict(zip(self.names, self.valley, strict=True)),
            "at_bound": list(self.at_bound),
        }


def identifiability(result: Fit, system: PoroSystem) -> Identifiability:
    """From a fit's covariance; parameters that were held are left out."""
    names, moved = [*THETA_NAMES, *(mode.name for mode in system.modes)], result.free
    unit = np.concatenate([STEP_SCALE, [3 * mode.sigma for mode in system.modes]])
    information = np.linalg.inv(result.covariance)[np.ix_(moved, moved)]
    covariance, unit = np.linalg.inv(information), unit[moved]
    sigma = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    low, high = bounds(system)
    theta, margin = result.theta.vector(), AT_BOUND * np.where(np.isfinite(high - low), high - low, 0)
    ended = moved & ((theta < low + margin) | (theta > high - margin))
    return Identifiability(
        tuple(name for name, free in zip(names, moved, strict=True) if free),
        sigma,
        covariance / np.outer(sigma, sigma),
        np.sqrt(values[::-1]),
        vectors[:, 0],
        tuple(name for name, stopped in zip(names, ended, strict=True) if stopped),
    )
