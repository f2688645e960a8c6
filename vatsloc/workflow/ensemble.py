"""The perturbation ensemble: the collapse fitted again from other starts and with slightly wrong inputs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from poro.collapse import PoroStatus, PoroSystem
from poro.fit import Fit, FitSettings, Target, fit_collapse
from registration.maps.rigid import RigidTransform
from registration.volume import Array

STARTS = ((1e-10, 0.6, 5.0), (1e-6, 0.9, 15.0))
AS_GOOD = 1.05
"""A fit from another start counts if its cost is at most this many times the best cost."""
TILT_RAD = np.radians(10.0)
HILUM_MM = 3.0


def perturbation_ensemble(system: PoroSystem, surface: Target, best: Fit, settings: FitSettings) -> Array:
    """Displacements (k, n, 3) mm of k further fits less those of the best one; fits that do not settle are left out.

    Fits: from two more starts; gravity tilted by 10 degrees about two axes; the hilum 3 mm off along three; either half
    of the surface alone.
    """
    theta = best.theta
    again = replace(settings, starts=((theta.kappa_b, theta.phi, theta.d_diaph_mm),))
    found = [fit_collapse(system, surface, replace(settings, starts=(start,))) for start in STARTS]
    found = [other for other in found if other.costs[0] <= AS_GOOD * best.costs.min()]
    found += [fit_collapse(other, target, again) for other, target in _perturbed(system, surface)]
    settled = [other.state.u - best.state.u for other in found if other.state.status is not PoroStatus.NOT_CONVERGED]
    return np.array(settled).reshape(-1, *best.state.u.shape)


def _perturbed(system: PoroSystem, surface: Target) -> Iterator[tuple[PoroSystem, Target]]:
    across = np.linalg.svd(system.gravity[None])[2][1:]
    for axis in across:
        tilt = RigidTransform.about(np.zeros(3), TILT_RAD * axis, np.zeros(3))
        yield replace(system, gravity=tilt(system.gravity[None])[0]), surface
    for axis in np.eye(3):
        yield replace(system, hilum_displacement=system.hilum_displacement + HILUM_MM * axis), surface
    along = surface.points @ across[0]
    for half in (along <= np.median(along), along > np.median(along)):
        yield system, replace(surface, weights=surface.weights * half)
