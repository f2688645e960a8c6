"""Pressure: layer profile, order of convergence, physical bounds over ten decades of kappa_b, derivative."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import diags
from shapes import box, ellipsoid, order

from poro.fem import Flow, Tissue
from poro.fem.forms import consistent_mass, laplacian
from poro.linalg import linear_solver
from poro.mesh import TetMesh, stuff_level_set

TISSUE = Tissue()


def _slab(n: int, kappa_b: float) -> tuple[float, float]:
    """L2 error of the layer between two plates 40 mm apart against cosh, sides without flux, lumped reaction."""
    width = 40.0
    mesh = box((n, 2, 2), (width, 10.0, 10.0))
    mass = diags(mesh.node_volumes).tocsr()
    matrix = (TISSUE.mobility * laplacian(mesh) + kappa_b * mass).tocsr()
    x = mesh.points[:, 0]
    held = (x == 0) | (x == width)
    p = np.where(held, TISSUE.pleural_kpa, 0.0)
    free = np.flatnonzero(~held)
    p[free] = linear_solver(matrix[free][:, free].tocsr(), mesh.points[free]).solve(-(matrix @ p)[free])
    layer = TISSUE.layer_mm(kappa_b)
    exact = TISSUE.pleural_kpa * np.cosh((x - width / 2) / layer) / np.cosh(width / 2 / layer)
    return float(np.sqrt((p - exact) @ (consistent_mass(mesh) @ (p - exact)))), width / n


def test_layer_profile_converges_with_second_order() -> None:
    errors, steps = zip(*(_slab(n, 5e-8) for n in (16, 32, 64)), strict=True)
    assert order(list(steps), list(errors))[-1] > 1.9


@pytest.mark.parametrize(("kappa_b", "layer"), [(1e-8, 12.26), (1e-7, 3.877), (1e-4, 0.1226)])
def test_layer_thickness_has_the_known_values(kappa_b: float, layer: float) -> None:
    assert TISSUE.layer_mm(kappa_b) == pytest.approx(layer, rel=1e-3)


@pytest.fixture(scope="module", params=["coarse", "fine", "thin"])
def body(request: pytest.FixtureRequest) -> TetMesh:
    if request.param == "thin":
        return stuff_level_set(
            lambda p: 14 - np.abs(p[:, 2]) - 1e-3 * (p[:, 0] ** 2 + p[:, 1] ** 2),
            -np.full(3, 100.0),
            np.full(3, 100.0),
            9.0,
        )
    return ellipsoid(14.0 if request.param == "coarse" else 8.5)


def test_pressure_stays_physical_for_every_kappa_b(body: TetMesh) -> None:
    flow = Flow(body, TISSUE)
    for kappa_b in 10.0 ** np.arange(-14, -3.5):
        p, _ = flow.pressure(kappa_b)
        assert p.max() <= TISSUE.pleural_kpa * (1 + 1e-9)
        assert p.min() >= -0.01 * TISSUE.pleural_kpa


def test_consistent_reaction_leaves_the_range_that_lumping_keeps() -> None:
    mesh = ellipsoid(9.0)
    lumped = Flow(mesh, TISSUE).pressure(1e-5)[0].min()
    consistent = Flow(mesh, TISSUE, lumped=False).pressure(1e-5)[0].min()
    assert consistent < -0.1 * TISSUE.pleural_kpa
    assert lumped > -0.01 * TISSUE.pleural_kpa


def test_limits_and_balance() -> None:
    mesh = ellipsoid(9.0)
    flow = Flow(mesh, TISSUE)
    assert_allclose(flow.pressure(0.0)[0], TISSUE.pleural_kpa)
    p, _ = flow.pressure(1e-8)
    evacuated = 1e-8 * mesh.node_volumes * p
    inflow = TISSUE.mobility * (laplacian(mesh) @ p)
    assert inflow[mesh.boundary.nodes].sum() == pytest.approx(evacuated[flow.inner].sum(), rel=1e-9)


@pytest.mark.parametrize("kappa_b", [1e-10, 1e-8, 1e-6])
def test_derivative_by_log_kappa(kappa_b: float) -> None:
    flow = Flow(ellipsoid(12.0), TISSUE)
    h = 1e-4
    difference = (flow.pressure(kappa_b * np.exp(h))[0] - flow.pressure(kappa_b * np.exp(-h))[0]) / (2 * h)
    assert_allclose(flow.pressure(kappa_b)[1], difference, atol=1e-7 * TISSUE.pleural_kpa)


def test_unresolved_layers_are_told() -> None:
    flow = Flow(ellipsoid(9.0), TISSUE)
    assert flow.resolved(1e-9) > 2
    assert flow.resolved(1e-5) < 0.2
    assert flow.resolved(1e-7) == pytest.approx(flow.resolved(1e-9) / 10)
    assert flow.layer(1e-9) == f"The pressure layer, 38.8 mm, spans {flow.resolved(1e-9):.1f} elements."
    assert flow.layer(1e-5).startswith("The pressure layer, 0.4 mm, is thinner than an element, 0.0")
    assert flow.layer(1e-5).endswith("the mesh is too coarse.")
