"""The strain measure a lung needs: linear while its answer stays in its range, finite where it does not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from poro.arrays import Array
from poro.collapse.finite_strain import FiniteProblem, FiniteState, FiniteStatus, WallContact, deform
from poro.collapse.model import PoroSystem, Theta
from poro.collapse.solution import PoroState, PoroStatus
from poro.fem.constitutive import ConstitutiveModel
from poro.fem.forms import body_load, deformation_gradient
from poro.fem.tissue import GRAVITY_KPA_PER_MM


class StrainMeasure(Enum):
    """Which strain measure an answer rests on."""

    LINEAR = "linear strain"
    FINITE = "finite strain"


MOST_STEPS = 30
"""Newton steps for the load of a fit. Three lungs that carried all of it took 18 to 26, one that did not took 112."""


@dataclass(frozen=True)
class LinearRange:
    """Where linear strain is believed: at most `share` of the elements may have det F below `min_det`."""

    min_det: float = 0.2
    share: float = 0.001


@dataclass(frozen=True)
class StrainChoice:
    """state: of the measure that was used; why: one sentence; share: of elements that the linear answer strains too
    far; finite: the finite-strain run, None when none was needed.
    """

    state: PoroState
    strain: StrainMeasure
    why: str
    share: float
    finite: FiniteState | None

    def entry(self) -> dict[str, str | float]:
        """What a run's record says of it."""
        return {"strain": self.strain.value, "why": self.why, "share_out_of_range": self.share}


def finite_problem(system: PoroSystem, theta: Theta, material: ConstitutiveModel) -> FiniteProblem:
    """The system's loads and wall for the finite-strain solver; raises ValueError for a system with load modes."""
    if system.modes:
        raise ValueError(f"finite strain knows no load modes, the system has {len(system.modes)}; assemble without")
    p, _ = system.flow.pressure(theta.kappa_b)
    tissue = system.tissue
    weight = body_load(system.mesh, system.gravity * GRAVITY_KPA_PER_MM * tissue.density(theta.phi))
    pressure_drop = tissue.biot * (tissue.pleural_kpa - p[system.mesh.tets].mean(axis=1))
    contact = WallContact(system.wall, system.contact_nodes, theta.d_diaph_mm)
    return FiniteProblem(system.mesh, material, system.hilum, system.hilum_displacement, weight, contact, pressure_drop)


def keep_in_range(
    system: PoroSystem, linear: PoroState, material: ConstitutiveModel, within: LinearRange | None = None
) -> StrainChoice:
    """The linear answer, for instance a fit's, where it is in its range; the same load on `material` where it is not.

    Raises ValueError when it is not and the system carries load modes, which finite strain does not know.
    """
    within = within or LinearRange()
    share = float((linear.det_f < within.min_det).mean())
    told = f"{100 * share:.2f} % of the elements have det F below {within.min_det} under linear strain"
    allowed = f"{100 * within.share:.2f} % allowed"
    if share <= within.share:
        return StrainChoice(linear, StrainMeasure.LINEAR, f"linear strain: {told}, {allowed}", share, None)
    finite = deform(finite_problem(system, linear.theta, material), most_steps=MOST_STEPS)
    if finite.status is not FiniteStatus.SOLVED:
        steps = len(finite.residuals)
        carried = f"{material.name} carried only {100 * finite.share:.0f} % of the load in {steps} Newton steps"
        why = f"linear strain although {told}, {allowed}: {carried}"
        return StrainChoice(linear, StrainMeasure.LINEAR, why, share, finite)
    state = _as_state(system, linear.theta, linear, finite)
    return StrainChoice(state, StrainMeasure.FINITE, f"{material.name}: {told}, {allowed}", share, finite)


def _as_state(system: PoroSystem, theta: Theta, linear: PoroState, finite: FiniteState) -> PoroState:
    nodes = system.contact_nodes
    u, active = finite.u, np.zeros(len(finite.u), bool)
    active[nodes] = finite.active
    gap, gradient, hessian = system.wall.gap(u[nodes], theta.d_diaph_mm)
    area = np.zeros(len(u))
    area[system.mesh.boundary.nodes] = system.mesh.boundary.node_areas
    contact = replace(
        linear.contact,
        u=u[nodes],
        force=finite.force,
        gap=gap,
        gradient=gradient,
        hessian=hessian,
        active=finite.active,
        steps=len(finite.residuals),
    )
    pressure = _spread(nodes, finite.force * np.linalg.norm(gradient, axis=1) / area[nodes], 0.0, len(u))
    return replace(
        linear,
        u=u,
        contact_pressure=pressure,
        det_f=np.linalg.det(deformation_gradient(system.mesh, u)),
        gap=_spread(nodes, gap, np.inf, len(u)),
        active=active,
        iterations=len(finite.residuals),
        contact=contact,
        status=PoroStatus.SOLVED,
    )


def _spread(nodes: Array, values: Array, elsewhere: float, count: int) -> Array:
    full = np.full(count, elsewhere)
    full[nodes] = values
    return full
