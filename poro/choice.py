"""The model a lung needs: linear while its answer stays in its range, finite strain where it does not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from poro.assembly import body_load, deformation_gradient
from poro.finite import FiniteProblem, FiniteState, FiniteStatus, Wall, deform
from poro.laws import Law
from poro.mesh.tetmesh import Array
from poro.model import PoroState, PoroStatus, PoroSystem, Theta, solve
from poro.tissue import GRAVITY_KPA_PER_MM


class Model(Enum):
    """Which strain measure an answer rests on."""

    LINEAR = "linear strain"
    FINITE = "finite strain"


@dataclass(frozen=True)
class Range:
    """Where linear strain is believed: at most `share` of the elements may have det F below `min_det`."""

    min_det: float = 0.2
    share: float = 0.001


@dataclass(frozen=True)
class Chosen:
    """state: of the model that ran; why: one sentence; finite: the finite-strain run, None when none was needed."""

    state: PoroState
    model: Model
    why: str
    finite: FiniteState | None


def finite_problem(system: PoroSystem, theta: Theta, law: Law) -> FiniteProblem:
    """The system's loads and wall for the finite-strain solver; raises ValueError for a system with load modes."""
    if system.modes:
        raise ValueError(f"finite strain knows no load modes, the system has {len(system.modes)}; assemble without")
    p, _ = system.flow.pressure(theta.kappa_b)
    tissue = system.tissue
    weight = body_load(system.mesh, system.gravity * GRAVITY_KPA_PER_MM * tissue.density(theta.phi))
    suction = tissue.biot * (tissue.pleural_kpa - p[system.mesh.tets].mean(axis=1))
    wall = Wall(system.obstacle, system.contact_nodes, theta.d_diaph_mm)
    return FiniteProblem(system.mesh, law, system.hilum, system.hilum_displacement, weight, wall, suction)


def solve_in_range(system: PoroSystem, theta: Theta, law: Law, within: Range | None = None) -> Chosen:
    """Solve linearly, and again by `law` at finite strain when the linear answer leaves its range."""
    within = within or Range()
    linear = solve(system, theta)
    share = float((linear.det_f < within.min_det).mean())
    told = f"{100 * share:.2f} % of the elements have det F below {within.min_det} under linear strain"
    allowed = f"{100 * within.share:.2f} % allowed"
    if share <= within.share:
        return Chosen(linear, Model.LINEAR, f"linear strain: {told}, {allowed}", None)
    finite = deform(finite_problem(system, theta, law))
    if finite.status is FiniteStatus.STOPPED:
        why = (
            f"linear strain although {told}, {allowed}: {law.name} carried only {100 * finite.share:.0f} % of the load"
        )
        return Chosen(linear, Model.LINEAR, why, finite)
    return Chosen(_as_state(system, theta, linear, finite), Model.FINITE, f"{law.name}: {told}, {allowed}", finite)


def _as_state(system: PoroSystem, theta: Theta, linear: PoroState, finite: FiniteState) -> PoroState:
    nodes = system.contact_nodes
    u, active = finite.u, np.zeros(len(finite.u), bool)
    active[nodes] = finite.active
    gap, gradient, hessian = system.obstacle.gap(u[nodes], theta.d_diaph_mm)
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
