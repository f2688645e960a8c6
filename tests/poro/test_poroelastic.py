"""Pressure and solid together: a poroelastic ball and column in closed form, Terzaghi's limit, the balance of work."""

from __future__ import annotations

import numpy as np
import pytest
from materials import saint_venant_kirchhoff
from scipy.sparse import diags
from scipy.special import spherical_in
from shapes import box, ellipsoid, order

from poro.arrays import Array
from poro.collapse import PoroState, PoroSystem, Theta, assemble, solve
from poro.collapse.choice import finite_problem
from poro.collapse.finite_strain import FiniteProblem, FiniteStatus, deform
from poro.fem import ConstitutiveModel, Flow, Tissue, neo_hookean, solid
from poro.fem.forms import consistent_mass, deformation_gradient, gradient_load, laplacian
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.linalg import linear_solver
from poro.mesh import TetMesh, stuff_level_set

TISSUE, STRAIGHT = Tissue(), Tissue(poisson=0.0)
HEIGHT = 40.0


def _l2(mesh: TetMesh, difference: Array) -> float:
    return float(np.sqrt((difference * (consistent_mass(mesh) @ difference)).sum() / mesh.volumes.sum()))


def _ball(edge_mm: float, radius: float) -> tuple[float, float, float]:
    """L2 errors of pressure (kPa) and displacement (mm) of a ball under pleural pressure; its surface's motion / exact.

    p = p_s i0(r / l) / i0(R / l), div u = alpha p / (lambda + 2 mu) + 3 c and u_r(0) = 0, with c from sigma_rr(R) = 0.
    """
    kappa_b = 2e-8
    layer = TISSUE.layer_mm(kappa_b)
    mesh = stuff_level_set(
        lambda x: radius - np.linalg.norm(x, axis=1), -np.full(3, radius + 9), np.full(3, radius + 9), edge_mm
    )
    p, _ = Flow(mesh, TISSUE).pressure(kappa_b)

    def exact_p(r: Array) -> Array:
        return TISSUE.pleural_kpa * spherical_in(0, r / layer) / spherical_in(0, radius / layer)

    def swell(r: Array) -> Array:
        """(1 / r^2) integral of alpha p r^2 / (lambda + 2 mu): l i1(r / l) is that of i0."""
        scale = TISSUE.pleural_kpa / spherical_in(0, radius / layer)
        return TISSUE.biot * scale * layer * spherical_in(1, r / layer) / (lame + 2 * mu)

    lame, mu = TISSUE.lame_kpa, TISSUE.shear_kpa
    h = swell(np.array([radius]))[0]
    # sigma_rr = (lambda + 2 mu) u' + 2 lambda u / r, u = swell + c r, swell' = alpha p / (lambda + 2 mu) - 2 swell / r.
    slope = TISSUE.biot * TISSUE.pleural_kpa / (lame + 2 * mu) - 2 * h / radius
    c = -((lame + 2 * mu) * slope + 2 * lame * h / radius) / (3 * lame + 2 * mu)
    r = np.linalg.norm(mesh.points, axis=1)
    radial = mesh.points / np.maximum(r, 1e-12)[:, None]
    exact = (swell(r) + c * r)[:, None] * radial
    held = np.argsort(r)[:4]
    u = solid(mesh, TISSUE, held).solve((TISSUE.biot * gradient_load(mesh) @ p).reshape(-1, 3), exact[np.sort(held)])
    outer = mesh.boundary.nodes
    inward = float((u[outer] * radial[outer]).sum(axis=1).mean()) / (h + c * radius)
    return _l2(mesh, p - exact_p(r)), _l2(mesh, u - exact), inward


def test_ball_under_pleural_pressure_shrinks_by_the_closed_form() -> None:
    steps = [8.0, 5.5, 4.0]
    p, u, motion = zip(*(_ball(edge, 40.0) for edge in steps), strict=True)
    assert order(steps, list(p))[-1] > 1.8
    assert order(steps, list(u)).min() > 1.8
    assert u[-1] < 0.05
    assert motion[-1] == pytest.approx(1, abs=0.015)


def _column(cells: int, kappa_b: float) -> float:
    """Mean vertical displacement of the top of a column, 40 mm high, pleural pressure on its top alone."""
    mesh = box((2, 2, cells), (10.0, 10.0, HEIGHT))
    z = mesh.points[:, 2]
    held, free = np.flatnonzero(z == HEIGHT), np.flatnonzero(z < HEIGHT)
    matrix = (TISSUE.mobility * laplacian(mesh) + kappa_b * diags(mesh.node_volumes)).tocsr()
    p = np.zeros(len(z))
    p[held] = TISSUE.pleural_kpa
    p[free] = linear_solver(matrix[free][:, free].tocsr(), mesh.points[free]).solve(-(matrix @ p)[free])
    load = (STRAIGHT.biot * gradient_load(mesh) @ p).reshape(-1, 3)
    return float(solid(mesh, STRAIGHT, np.flatnonzero(z == 0)).solve(load)[held, 2].mean())


def test_column_sinks_by_the_closed_form() -> None:
    """nu = 0: E u' = alpha (p - p_s) with p = p_s cosh(z / l) / cosh(H / l)."""
    layer, steps = TISSUE.layer_mm(2e-8), [4.0, 2.0, 1.0]
    strain = STRAIGHT.biot * STRAIGHT.pleural_kpa / STRAIGHT.young_kpa
    exact = strain * (layer * np.tanh(HEIGHT / layer) - HEIGHT)
    errors = [abs(_column(round(HEIGHT / step), 2e-8) / exact - 1) for step in steps]
    assert exact < -20
    assert order(steps, errors).min() > 1.8
    assert errors[-1] < 1e-3


@pytest.mark.parametrize("cells", [10, 40])
def test_evacuated_column_reaches_terzaghis_settlement(cells: int) -> None:
    """With all air gone the skeleton carries p_s alone: H p_s / E, less half of the element that holds the layer."""
    drained = -STRAIGHT.biot * STRAIGHT.pleural_kpa / STRAIGHT.young_kpa
    assert _column(cells, 1e-3) == pytest.approx(drained * (HEIGHT - HEIGHT / cells / 2), rel=5e-4)


@pytest.fixture(scope="module")
def system() -> PoroSystem:
    mesh = ellipsoid(16.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    return assemble(mesh, TISSUE, np.array([-0.6, 0, -0.8]), held, np.zeros((len(held), 3)))


def _work_of_loads(system: PoroSystem, state: PoroState) -> float:
    """Of pressure and weight through the final displacement, kPa mm3, element by element."""
    mesh = system.mesh
    mean = state.u[mesh.tets].mean(axis=1)
    slope = np.einsum("ma,mad->md", state.p[mesh.tets], mesh.gradients)
    weight = system.gravity * GRAVITY_KPA_PER_MM * TISSUE.density(state.theta.phi)
    return float(np.einsum("md,md,m->", weight - TISSUE.biot * slope, mean, mesh.volumes))


def _elastic_energy(mesh: TetMesh, u: Array) -> float:
    gradient = deformation_gradient(mesh, u) - np.eye(3)
    strain = (gradient + gradient.transpose(0, 2, 1)) / 2
    trace = np.einsum("mii->m", strain)
    density = TISSUE.lame_kpa / 2 * trace**2 + TISSUE.shear_kpa * np.einsum("mij,mij->m", strain, strain)
    return float(density @ mesh.volumes)


@pytest.mark.parametrize("theta", [Theta(1e-9, 0.9), Theta(1e-8, 0.6), Theta(1e-7, 0.8, 6.0)])
def test_loads_do_twice_the_work_that_the_lung_stores(system: PoroSystem, theta: Theta) -> None:
    """Clapeyron's theorem with the wall's forces among the loads, and pressure times gap is nothing."""
    state = solve(system, theta, tolerance_mm=1e-8)
    push = state.contact.gradient * state.contact.force[:, None]
    by_wall = float((push * state.u[system.contact_nodes]).sum())
    stored = _elastic_energy(system.mesh, state.u)
    assert _work_of_loads(system, state) + by_wall == pytest.approx(2 * stored, rel=1e-9)
    assert state.contact.force.max() > 0
    assert float(np.abs(state.contact.force * state.contact.gap).sum()) < 1e-8 * stored


@pytest.mark.parametrize(
    ("material", "theta"),
    [(saint_venant_kirchhoff(TISSUE), Theta(3e-10, 0.9)), (neo_hookean(TISSUE), Theta(1e-8, 0.85))],
    ids=["Saint Venant-Kirchhoff", "neo-Hookean"],
)
def test_finite_strain_stores_the_work_done_along_the_path(
    system: PoroSystem, material: ConstitutiveModel, theta: Theta
) -> None:
    """Loads s P'(u) from s = 0 to 1 do P(1) - integral of P ds; neither a fixed hilum nor a rigid wall does any."""
    problem = finite_problem(system, theta, material)
    assert problem.pressure_drop is not None
    drop = problem.pressure_drop

    def at(share: float) -> tuple[float, Array]:
        part = FiniteProblem(
            problem.mesh, material, problem.fixed, problem.imposed, share * problem.load, problem.contact, share * drop
        )
        state = deform(part)
        assert state.status is FiniteStatus.SOLVED
        f = deformation_gradient(problem.mesh, state.u)
        shrunk = float(drop * (1 - np.linalg.det(f)) @ problem.mesh.volumes)
        return float((problem.load * state.u).sum()) + shrunk, f

    x, w = np.polynomial.legendre.leggauss(4)
    path = sum(float(weight) / 2 * at((node + 1) / 2)[0] for node, weight in zip(x, w, strict=True))
    end, f = at(1.0)
    stored = float(material.respond(f)[0] @ problem.mesh.volumes)
    assert end - path == pytest.approx(stored, rel=2e-3)
