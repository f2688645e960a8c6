"""Contact against Hertz: force, radius and pressure of a rigid paraboloid pressed into an elastic half-space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hertz import half_block, half_space
from numpy.testing import assert_allclose
from shapes import compliance_of, order

from poro.arrays import Array
from poro.contact import ChestWall, ContactState, ContactStatus, LevelSet, solve_contact
from poro.fem import Tissue, solid

TISSUE = Tissue()
RADIUS, CONTACT = 400.0, 8.0  # mm; the wall's slope at the contact's edge is 1 : 50
MODULUS = TISSUE.young_kpa / (1 - TISSUE.poisson**2)
DEPTH = CONTACT**2 / RADIUS
FORCE = 4 / 3 * MODULUS * np.sqrt(RADIUS) * DEPTH**1.5
PEAK = 2 * MODULUS * CONTACT / (np.pi * RADIUS)


def _paraboloid(step: float = 8.0) -> LevelSet:
    """Distance below the paraboloid z = r^2 / 2 R - depth; cubic B-splines hold it exactly."""
    k = np.arange(-8, 9) * step
    square = (k**2 - step**2 / 3) / (2 * RADIUS)
    level = square[:, None, None] + square[None, :, None] - k[None, None, :] - DEPTH
    return LevelSet(level, np.full(3, -8 * step), step)


@dataclass(frozen=True)
class Indent:
    """One solved indentation. finest: edge under the contact, mm; area: of every contact node, mm2."""

    finest: float
    state: ContactState
    rest: Array
    area: Array


def _indent(cells: int, finest: float) -> Indent:
    mesh = half_block(cells, finest, CONTACT)
    boundary = mesh.boundary
    x, y, z = mesh.points.T
    far = 4 * CONTACT * (1 - 1e-9)
    held = np.flatnonzero((np.abs(x) >= far) | (np.abs(y) >= far) | (z <= -far))
    top = np.setdiff1d(np.flatnonzero(z == 0), held)
    nodes = top[np.hypot(x[top], y[top]) < 1.5 * CONTACT]
    body = solid(mesh, TISSUE, held)
    free = body.solve(np.zeros_like(mesh.points), half_space(mesh.points[held], CONTACT, PEAK, TISSUE))
    still = np.zeros(len(nodes), bool)
    wall = ChestWall(_paraboloid(), mesh.points[nodes], still, np.array([0, 0, 1.0]), np.zeros(len(nodes)))
    state = solve_contact(compliance_of(body, nodes), wall, free[nodes], 0.0)
    area = np.zeros(len(mesh.points))
    area[boundary.nodes] = boundary.node_areas
    return Indent(finest, state, mesh.points[nodes], area[nodes])


@pytest.fixture(scope="module")
def indents() -> list[Indent]:
    return [_indent(cells, CONTACT / per_radius) for cells, per_radius in ((8, 4), (11, 6), (13, 8))]


def test_half_space_sinks_by_hertz_inside_and_outside_the_contact() -> None:
    """Approach at the middle, and u_z at 3 radii: (4 a^2 - 2 r^2) asin(a / r) + 2 r^2 sqrt(a^2 / r^2 - a^4 / r^4)."""
    below = np.array([[3 * CONTACT, 0, -1e-6], [0, 3 * CONTACT, -1e-6]])
    r, a = 3 * CONTACT, CONTACT
    exact = PEAK / (4 * MODULUS * a) * ((4 * a**2 - 2 * r**2) * np.arcsin(a / r) + 2 * r * np.sqrt(r**2 - a**2) * a / r)
    assert_allclose(half_space(below, CONTACT, PEAK, TISSUE)[:, 2], -exact, rtol=1e-4)


def test_force_radius_and_pressure_converge_to_hertz(indents: list[Indent]) -> None:
    """Linear elements resolve the contact's edge to half an element: force to first order, peak pressure to more."""
    steps = [i.finest for i in indents]
    force = [abs(i.state.force.sum() / FORCE - 1) for i in indents]
    peak = [abs((i.state.force / i.area).max() / PEAK - 1) for i in indents]
    assert order(steps, force).min() > 1.0
    assert order(steps, peak).min() > 1.5
    assert force[-1] < 0.035
    assert peak[-1] < 0.02
    for i in indents:
        assert i.state.status is ContactStatus.CONVERGED
        radius = np.sqrt(i.area[i.state.active].sum() / np.pi)
        assert radius == pytest.approx(CONTACT, abs=0.5 * i.finest)


def test_pressure_follows_hertz_inside_and_vanishes_outside(indents: list[Indent]) -> None:
    finest = indents[-1]
    r = np.linalg.norm(finest.rest[:, :2], axis=1) / CONTACT
    pressure = finest.state.force / finest.area / PEAK
    inner = r < 0.85
    assert_allclose(pressure[inner], np.sqrt(1 - r[inner] ** 2), atol=0.05)
    assert (pressure[r > 1 + finest.finest / CONTACT] == 0).all()
    assert_allclose(finest.state.gap[pressure > 0], 0, atol=1e-6)
