"""The reduced basis of pressures against whole solutions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from shapes import ellipsoid

from poro.arrays import Array
from poro.collapse import PoroSystem, assemble
from poro.fem import PressureBasis, Solid, Tissue
from poro.fem.flow import Flow


@pytest.fixture(scope="module")
def system() -> PoroSystem:
    mesh = ellipsoid(14.0)
    held = np.flatnonzero(np.linalg.norm(mesh.points - [-30, 0, 0], axis=1) < 16)
    return assemble(mesh, Tissue(), np.array([-1.0, 0, 0]), held, np.broadcast_to([1.0, 0, 2.0], (len(held), 3)))


def test_basis_gives_whole_solutions_and_stops_growing(system: PoroSystem) -> None:
    basis, flow = system.pressure_basis, system.flow
    for kappa_b in np.geomspace(1e-14, 1e-4, 30):
        basis.solve(kappa_b)
    known = basis.size
    assert known < 60
    for kappa_b in 10 ** np.random.default_rng(0).uniform(-13, -5, 12):
        found = basis.solve(kappa_b)
        p, change = flow.pressure(kappa_b)
        drop = np.abs(p - system.tissue.pleural_kpa).max()
        assert_allclose(found.p, p, atol=1e-8 * drop)
        assert_allclose(found.p_change, change, atol=1e-8 * drop)
        u = system.solid.solve((system.pressure_load @ p).reshape(-1, 3))
        assert_allclose(found.u, u, atol=1e-7 * np.abs(u).max())
        du = system.solid.solve((system.pressure_load @ change).reshape(-1, 3))
        assert_allclose(found.u_change, du, atol=1e-7 * np.abs(u).max())
    assert basis.size - known < 12


def test_no_evacuation_leaves_the_pleural_pressure(system: PoroSystem) -> None:
    still = system.pressure_basis.solve(0.0)
    assert_allclose(still.p, system.tissue.pleural_kpa, rtol=1e-14)
    assert_allclose(still.u, 0, atol=1e-12)
    with pytest.raises(ValueError, match="kappa_b must be 0 or more"):
        system.pressure_basis.solve(-1e-9)


def test_rates_added_together_take_one_elastic_solution(system: PoroSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    rates = (1e-9, 1e-8, 1e-7)
    alone = [PressureBasis(system.flow, system.solid, system.pressure_load).solve(kappa_b) for kappa_b in rates]
    solved: list[int] = []
    plain = Solid.solve

    def counted(self: Solid, force: Array, imposed: Array | None = None) -> Array:
        solved.append(force.shape[2])
        return plain(self, force, imposed)

    monkeypatch.setattr(Solid, "solve", counted)
    together = PressureBasis(system.flow, system.solid, system.pressure_load)
    together.enrich(rates)
    assert together.size == 6
    for kappa_b, one in zip(rates, alone, strict=True):
        found = together.solve(kappa_b)
        assert_allclose(found.u, one.u, atol=1e-8 * np.abs(one.u).max())
        assert_allclose(found.u_change, one.u_change, atol=1e-7 * np.abs(one.u_change).max())
    assert solved == [6]


def test_a_rate_that_the_basis_knows_is_not_solved_in_full(system: PoroSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    basis = PressureBasis(system.flow, system.solid, system.pressure_load)
    basis.enrich(np.geomspace(1e-9, 1e-7, 9))
    whole: list[float] = []
    plain = Flow.pressure

    def counted(self: Flow, kappa_b: float) -> tuple[Array, Array]:
        whole.append(kappa_b)
        return plain(self, kappa_b)

    monkeypatch.setattr(Flow, "pressure", counted)
    for kappa_b in (1.5e-9, 4e-9, 2.2e-8, 7e-8):
        basis.solve(kappa_b)
    assert whole == []
    basis.solve(1e-5)
    assert whole == [1e-5]
