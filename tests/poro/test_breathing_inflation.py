"""Lungs filled to a volume: closed-form pressure, the cavity, the pressure-volume curve, one scan."""

from __future__ import annotations

import numpy as np
import pytest
from breathing_shapes import pear
from numpy.testing import assert_allclose
from scipy.sparse import diags

from poro.arrays import Array
from poro.breathing import one_scan as module
from poro.breathing.cavity import TISSUE as TISSUE_OF_LUNG
from poro.breathing.cavity import inflating
from poro.breathing.elastic import Lung
from poro.breathing.equilibrium import Balance, Cavity, ConstraintTerms, Scene, _tissue, balance, volume
from poro.breathing.inflation import Filled, _swelling, fill, fill_to
from poro.breathing.one_scan import _wall, one_scan, regions
from poro.breathing.pressure_volume import PER_PA, inspired_volume, pressure_volume, recoil_pa
from poro.contact.levelset import level_set
from poro.fem import Tissue, neo_hookean
from poro.mesh import TetMesh

TISSUE = Tissue()


def free_scene(mesh: TetMesh, transpulmonary_kpa: float = 0.0) -> Scene:
    anchor = diags(np.full(3 * len(mesh.points), 1e-7)).tocsr()
    return Scene(mesh, neo_hookean(TISSUE), ConstraintTerms(anchor, np.zeros_like(mesh.points)), transpulmonary_kpa)


def pressure(s: float) -> float:
    """Of a neo-Hookean body that swells freely by s: mu (s^2 - 1) / s^3 + 3 lambda ln s / s^3."""
    return (TISSUE.shear_kpa * (s**2 - 1) + 3 * TISSUE.lame_kpa * np.log(s)) / s**3


@pytest.mark.parametrize("s", [0.9, 1.12])
def test_a_free_lung_swells_evenly_under_its_closed_form_pressure(s: float) -> None:
    mesh = pear()
    found = fill_to(free_scene(mesh), s**3 * float(mesh.volumes.sum()), (s - 1) * mesh.points * 0.5)
    reached = np.cbrt(found.volume_mm3 / mesh.volumes.sum())
    assert reached == pytest.approx(s, abs=0.01)
    assert (found.transpulmonary_kpa > 0) == (s > 1)
    assert found.transpulmonary_kpa == pytest.approx(pressure(reached), rel=0.02)
    shift = found.u - (reached - 1) * mesh.points
    assert_allclose(shift - shift.mean(axis=0), 0, atol=0.1)


def test_recoil_of_an_even_swelling_is_its_closed_form() -> None:
    mesh, s = pear(), 1.07
    assert recoil_pa(mesh, s * mesh.points, TISSUE) == pytest.approx(1000 * pressure(s), rel=1e-9)


def test_balance_under_a_given_pressure_is_the_same_swelling() -> None:
    mesh, s = pear(), 1.1
    found = balance(free_scene(mesh, pressure(s)), (s - 1) * mesh.points * 0.9, tolerance=1e-7)
    assert found.balance is Balance.BALANCED
    assert volume(mesh, found.u) / mesh.volumes.sum() == pytest.approx(s**3, rel=1e-4)
    assert found.residuals[-1] < 1e-7


def test_the_force_of_a_unit_pressure_is_the_volume_s_derivative() -> None:
    """Where tissue is sheared and turned, so that no gradient is symmetric."""
    mesh, rng, h = pear(), np.random.default_rng(2), 1e-4
    u = mesh.points @ np.array([[0.1, 0.3, -0.2], [-0.1, 0.05, 0.25], [0.15, -0.3, -0.1]])
    way = rng.normal(size=mesh.points.shape)
    slope = (volume(mesh, u + h * way) - volume(mesh, u - h * way)) / (2 * h)
    assert (_swelling(free_scene(mesh), u) * way).sum() == pytest.approx(slope, rel=1e-6)


def test_stress_and_moduli_of_tissue_under_pressure_are_the_derivatives_of_its_energy() -> None:
    scene, rng, h = free_scene(pear(), 0.7), np.random.default_rng(3), 1e-5
    f, way = np.eye(3) + 0.2 * rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3, 3))
    (energy, stress, moduli), ahead, behind = (_tissue(scene, f + t * way) for t in (0, h, -h))
    assert_allclose((ahead[0] - behind[0]) / (2 * h), np.einsum("mij,mij->m", stress, way), rtol=1e-6)
    assert_allclose((ahead[1] - behind[1]) / (2 * h), np.einsum("mijkl,mkl->mij", moduli, way), rtol=1e-5, atol=1e-6)
    assert np.isfinite(energy).all()


def test_a_printed_scene_leaves_its_elimination_tree_out() -> None:
    assert "tree" not in repr(free_scene(pear()))


def test_a_lung_fills_its_cavity_and_stays_within() -> None:
    expired, inspired = pear(), pear(stretch=np.array([1.05, 1.1, 1.15]))
    scene = inflating(Lung("right", inspired, expired))
    phases = list(fill(scene.at, [0.5, 1.0], scene.volume, scene.guess))
    for share, phase in zip((0.5, 1.0), phases, strict=True):
        assert phase.volume_mm3 == pytest.approx(scene.volume(share), rel=0.02)
    for share, phase in zip((0.5, 1.0), phases, strict=True):
        cavity = scene.at(share).cavity
        assert cavity is not None
        gap = cavity.distance(expired.points[cavity.nodes] + phase.u[cavity.nodes])[0] - cavity.offset
        assert np.abs(gap).mean() < 1.0  # no gas lets the lung leave its wall
        assert np.abs(gap).max() < 3.0
    recoil = [recoil_pa(expired, expired.points + phase.u, TISSUE_OF_LUNG) for phase in phases]
    assert recoil[1] > recoil[0] > 0
    top, bottom = expired.points[:, 2] > 40, expired.points[:, 2] < -20
    assert phases[-1].u[top, 2].mean() > 2 > -2 > phases[-1].u[bottom, 2].mean()


def test_the_inflation_of_a_lung_settles_step_by_step() -> None:
    expired, inspired = pear(), pear(stretch=np.array([1.05, 1.1, 1.15]))
    scene = inflating(Lung("right", inspired, expired))
    phases = list(fill(scene.at, [0.5, 1.0], scene.volume, scene.guess))
    assert all(phase.settled for phase in phases)
    assert max(phase.steps for phase in phases) < 9


@pytest.mark.parametrize("off", [6.0, -6.0])
def test_the_cavity_s_stiffness_is_the_derivative_of_its_force_where_that_is_convex(off: float) -> None:
    """Nodes of a ball, outside of or within where they touch: the wall's curvature stiffens one and not the other."""
    mesh = pear()
    nodes = mesh.boundary.nodes[::7]
    level = level_set(mesh.boundary, 5.0, 2.5)
    cavity = Cavity(((1.0, level),), nodes, np.full(len(nodes), 2.0), np.full(len(nodes), off), pull=1.0)
    block, h = cavity.respond(mesh.points)[2], 1e-4
    rng = np.random.default_rng(4)
    way = rng.normal(size=mesh.points.shape)
    ahead, behind = (cavity.respond(mesh.points + t * way)[1] for t in (h, -h))
    exact = -((ahead - behind) / (2 * h) * way).sum(axis=1)[nodes]
    found = np.einsum("ni,nij,nj->n", way, block, way)[nodes]
    assert (found >= exact - 1e-6).all()
    assert (found >= -1e-9).all()
    if off > 0:
        assert (np.abs(found - exact) < 1e-3).mean() > 0.3


def test_the_pressure_volume_curve_runs_both_ways_and_starts_with_its_compliance() -> None:
    inspired = np.linspace(0, 500, 11)
    pressure = pressure_volume(inspired, 2400.0)
    compliance = 200 / 98.07
    assert pressure[0] == 0
    assert (np.diff(pressure, 2) > 0).all()
    assert pressure[1] == pytest.approx(50 / compliance, rel=0.05)
    assert_allclose(inspired_volume(pressure, 0.083 / 98.07 * 2400), inspired, rtol=1e-9)
    assert PER_PA * pressure_volume(np.array([0.0, 9000.0]), 2400.0)[1] == pytest.approx(-np.log(0.05))


@pytest.mark.parametrize("feet", [-1.0, 1.0])
def test_apex_spine_and_diaphragm_lie_where_they_should(feet: float) -> None:
    mesh = pear(14.0)
    if feet > 0:
        mesh = TetMesh(mesh.points * [-1, 1, -1], mesh.tets)
    surface = mesh.boundary
    where = regions(surface, "right", feet)
    up = -feet * surface.points[:, 2]
    assert up[where.diaphragm].max() < -15
    assert where.diaphragm.sum() > 20
    assert up[where.apex].min() > 50
    assert (surface.points[where.spine, 0] < 0).all()  # the right lung's inner side
    assert (surface.points[where.flank, 0] > 0).all()
    assert not (where.diaphragm & where.spine).any()


def test_the_wall_asks_chest_and_diaphragm_for_their_shares_of_a_breath() -> None:
    """Forces of 1 mm3 are the constraints' own at the step that makes it: 45 % by the chest, the rest downwards."""
    mesh = pear(18.0)
    surface, area = mesh.boundary, mesh.boundary.node_areas
    where = regions(surface, "right", -1.0)
    matrix, force = _wall(mesh, "right", where, -1.0)
    blocks = matrix.toarray().reshape(len(mesh.points), 3, -1)
    own = np.stack([blocks[n, :, 3 * n : 3 * n + 3] for n in surface.nodes])
    normal, down = surface.node_normals, np.array([0.0, 0.0, -1.0])
    firm = np.where(where.diaphragm, 0.03, 0.3) * area
    along = np.where(where.diaphragm[:, None], down, normal)
    assert_allclose(own, firm[:, None, None] * along[:, :, None] * along[:, None, :], atol=1e-12)
    pushed = np.einsum("nd,nd->n", force[surface.nodes], along) / firm  # mm for 1 mm3
    made = area * np.einsum("nd,nd->n", pushed[:, None] * along, normal)
    assert made[where.diaphragm].sum() == pytest.approx(0.55)
    assert made[~where.diaphragm].sum() == pytest.approx(0.45)
    assert np.abs(force[np.setdiff1d(np.arange(len(mesh.points)), surface.nodes)]).max() == 0


def test_the_diaphragm_s_traction_follows_the_logarithm_of_the_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Scene] = []

    def watched(scene: Scene, wanted: float, u: Array) -> Filled:
        asked.append(scene)
        return Filled(u, 0.0, 1, True, wanted)

    monkeypatch.setattr(module, "fill_to", watched)
    scene = one_scan(pear(18.0), "right")
    rest, more = float(scene.mesh.volumes.sum()), 1.2
    scene.states([more * rest, more * rest], traction=0.5)
    scene.states([more * rest], traction=0.7)
    assert_allclose(asked[0].constraints.force, asked[1].constraints.force)
    pulled = asked[2].constraints.force - asked[0].constraints.force
    assert_allclose(pulled, 0.2 * scene.bulk_kpa * np.log(more) * scene.pull, atol=1e-12)
    area = scene.mesh.boundary.node_areas[scene.regions.diaphragm].sum()
    assert scene.pull.sum(axis=0) == pytest.approx([0, 0, -area])
    tissue = Tissue()
    assert scene.bulk_kpa == pytest.approx(tissue.young_kpa / 3 / (1 - 2 * tissue.poisson))


def test_a_breath_of_one_scan_lowers_the_diaphragm_and_keeps_the_apex() -> None:
    mesh = pear(18.0)
    scene = one_scan(mesh, "right")
    rest = float(mesh.volumes.sum())
    filled, emptied = scene.states([1.15 * rest])[0], scene.states([0.85 * rest])[0]
    nodes = mesh.boundary.nodes
    for found, share in ((filled, 1.15), (emptied, 0.85)):
        assert found.volume_mm3 == pytest.approx(share * rest, rel=0.02)
        assert np.abs(found.u[nodes[scene.regions.apex]]).max() < 0.5
    down = filled.u[nodes[scene.regions.diaphragm], 2].mean()
    assert down < -1
    assert emptied.u[nodes[scene.regions.diaphragm], 2].mean() > 1
    assert filled.transpulmonary_kpa > 0 > emptied.transpulmonary_kpa
