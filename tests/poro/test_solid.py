"""Elasticity against closed forms: patch, rigid motions, gravity column, manufactured solution, element matrices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.sparse import csr_matrix, identity
from shapes import box, ellipsoid, order
from skfem import BilinearForm
from skfem.helpers import grad

import poro.linalg.solver
from poro.arrays import Array
from poro.collapse.modes import eigenstrain_mode
from poro.errors import SolverError
from poro.fem import Tissue, solid
from poro.fem.forms import (
    body_load,
    consistent_mass,
    deformation_gradient,
    eigenstress_load,
    gradient_load,
    laplacian,
    lumped_mass,
    stiffness,
    tangent_stiffness,
    vector_basis,
)
from poro.fem.solid import continued
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from poro.linalg.cholesky import cholesky
from poro.linalg.solver import (
    Multigrid,
    SingleFactor,
    elimination_tree,
    linear_solver,
    rigid_body_modes,
    solver_for_few,
)
from poro.mesh import TetMesh

TISSUE = Tissue()


def test_scikit_fems_matrices_equal_products_over_the_elements() -> None:
    """The closed forms of linear tetrahedra, element by element, and the batched tangent at constant moduli."""
    mesh = ellipsoid(20.0)
    lame, mu, g, volume = TISSUE.lame_kpa, TISSUE.shear_kpa, mesh.gradients, mesh.volumes
    eye = np.eye(3)

    def near(ours: csr_matrix, local: Array, rows: int, columns: int) -> None:
        """Against element matrices (m, 4, rows, 4, columns), summed one entry at a time."""
        expected = np.zeros(ours.shape)
        for a in range(4):
            for b in range(4):
                for i in range(rows):
                    for j in range(columns):
                        at = rows * mesh.tets[:, a] + i, columns * mesh.tets[:, b] + j
                        np.add.at(expected, at, local[:, a, i, b, j])
        assert np.abs(ours.toarray() - expected).max() <= 1e-12 * np.abs(expected).max()

    moduli = lame * np.einsum("ij,kl->ijkl", eye, eye)
    moduli = moduli + mu * (np.einsum("ik,jl->ijkl", eye, eye) + np.einsum("il,jk->ijkl", eye, eye))
    elastic = np.einsum("maj,ijkl,mbl,m->maibk", g, moduli, g, volume)
    near(stiffness(mesh, lame, mu), elastic, 3, 3)
    near(laplacian(mesh), np.einsum("mai,mbi,m->mab", g, g, volume)[:, :, None, :, None], 1, 1)
    mass = np.einsum("ab,m->mab", (np.ones((4, 4)) + np.eye(4)) / 20, volume)
    near(consistent_mass(mesh), mass[:, :, None, :, None], 1, 1)
    near(gradient_load(mesh), -np.einsum("mbi,m,a->maib", g, volume / 4, np.ones(4))[..., None], 3, 1)
    assert_allclose(lumped_mass(mesh).toarray(), np.diag(mesh.node_volumes), rtol=1e-12)
    assert_allclose(lumped_mass(mesh).diagonal(), np.asarray(consistent_mass(mesh).sum(axis=1)).ravel(), rtol=1e-12)
    density, stress = np.array([0.3, -0.2, 0.7]), np.random.default_rng(0).normal(size=(len(mesh.tets), 3, 3))
    assert_allclose(body_load(mesh, density), mesh.node_volumes[:, None] * density, rtol=1e-12)
    force = np.zeros_like(mesh.points)
    np.add.at(force, mesh.tets, np.einsum("mij,maj,m->mai", stress, g, volume))
    assert_allclose(eigenstress_load(mesh, stress), force, atol=1e-12 * np.abs(force).max())


def test_batched_tangent_equals_its_form() -> None:
    """It stays a batched product for its speed; the equation is scikit-fem's, of moduli without any symmetry."""
    mesh = ellipsoid(20.0)
    moduli = np.random.default_rng(1).normal(size=(len(mesh.tets), 3, 3, 3, 3))

    @BilinearForm
    def tangent(u, v, w):  # type: ignore[no-untyped-def]
        return np.einsum("ij...,ijkl...,kl...->...", grad(v), w.moduli, grad(u))

    form = tangent.assemble(vector_basis(mesh), moduli=moduli.transpose(1, 2, 3, 4, 0)[..., None])
    assert abs(tangent_stiffness(mesh, moduli) - form).max() <= 1e-12 * abs(form).max()


def test_the_stiffness_is_made_once_for_a_mesh_and_material() -> None:
    mesh = ellipsoid(25.0)
    first = stiffness(mesh, 0.5, 0.2)
    assert stiffness(mesh, 0.5, 0.2) is first
    assert stiffness(TetMesh(mesh.points, mesh.tets), 0.5, 0.2) is not first
    assert abs(stiffness(mesh, 1.0, 0.4) - 2 * first).max() <= 1e-12 * abs(first).max()


def test_rigid_motions_cost_no_energy() -> None:
    mesh = ellipsoid(16.0)
    matrix = stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa)
    modes = rigid_body_modes(mesh.points)
    assert_allclose(matrix @ modes, 0, atol=1e-10 * abs(matrix).max() * np.abs(modes).max())
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()


def test_patch_of_constant_strain_is_exact() -> None:
    mesh = ellipsoid(14.0)
    gradient = np.array([[0.02, -0.01, 0.03], [0.04, -0.05, 0.01], [0.0, 0.02, 0.03]])
    exact = mesh.points @ gradient.T + [1, 2, 3]
    outer = mesh.boundary.nodes
    u = solid(mesh, TISSUE, outer).solve(np.zeros_like(exact), exact[outer])
    assert_allclose(u, exact, atol=1e-10)
    assert_allclose(
        deformation_gradient(mesh, u), np.broadcast_to(np.eye(3) + gradient, (len(mesh.tets), 3, 3)), atol=1e-10
    )


def test_column_under_its_own_weight() -> None:
    """nu = 0: u_z = -rho g (H z - z^2 / 2) / E, sign, value and order."""
    tissue = Tissue(poisson=0.0)
    height, density, errors, steps = 100.0, 300.0, [], []
    for n in (1, 2, 4):
        mesh = box((2 * n, 2 * n, 5 * n), (40.0, 40.0, height))
        z = mesh.points[:, 2]
        bottom = np.flatnonzero(z == 0)
        down = np.array([0, 0, -GRAVITY_KPA_PER_MM * density])
        u = solid(mesh, tissue, bottom).solve(body_load(mesh, down))
        exact = -GRAVITY_KPA_PER_MM * density / tissue.young_kpa * (height * z - z**2 / 2)
        difference = u[:, 2] - exact
        errors.append(float(np.sqrt(difference @ (consistent_mass(mesh) @ difference))))
        steps.append(height / n)
        assert u[z == height, 2].max() < 0
    assert order(steps, errors)[-1] > 1.7
    assert u[z == height, 2].mean() == pytest.approx(-GRAVITY_KPA_PER_MM * density / 0.55 * height**2 / 2, rel=0.02)


def test_manufactured_displacement_converges_with_second_order() -> None:
    lame, mu = TISSUE.lame_kpa, TISSUE.shear_kpa
    k = np.pi / 30.0

    def exact(x: Array) -> Array:
        s, c = np.sin(k * x), np.cos(k * x)
        return np.stack([s[:, 0] * s[:, 1] * s[:, 2], 0 * s[:, 0], c[:, 0] * s[:, 1] * s[:, 2]], 1)

    def force(x: Array) -> Array:
        """-div sigma of `exact`: -mu laplace u - (lambda + mu) grad div u; div u = k (c s s + c s c)."""
        s, c = np.sin(k * x), np.cos(k * x)
        (s0, s1, s2), (c0, c1, c2) = s.T, c.T
        grad_div = k**2 * np.stack([-s0 * s1 * (s2 + c2), c0 * c1 * (s2 + c2), c0 * s1 * (c2 - s2)], 1)
        return 3 * mu * k**2 * exact(x) - (lame + mu) * grad_div

    errors, steps = [], []
    for n in (4, 8, 16):
        mesh = box((n, n, n), (30.0, 30.0, 30.0))
        outer = mesh.boundary.nodes
        load = (consistent_mass(mesh) @ force(mesh.points)).reshape(-1, 3)
        u = solid(mesh, TISSUE, outer).solve(load, exact(mesh.points)[outer])
        difference = u - exact(mesh.points)
        errors.append(float(np.sqrt(np.einsum("nd,nd->", difference, consistent_mass(mesh) @ difference))))
        steps.append(30.0 / n)
    assert order(steps, errors)[-1] > 1.8


def test_uniform_eigenstrain_shrinks_without_stress() -> None:
    mesh = ellipsoid(14.0)
    strain = np.broadcast_to(-0.2 * np.eye(3), (len(mesh.tets), 3, 3))
    mode = eigenstrain_mode(mesh, TISSUE, "all", strain, 1.0)
    held = np.argsort(np.linalg.norm(mesh.points, axis=1))[:4]
    u = solid(mesh, TISSUE, held).solve(mode.force, -0.2 * mesh.points[held])
    assert_allclose(u, -0.2 * mesh.points, atol=1e-9)


def test_eigenstress_is_in_balance() -> None:
    mesh = ellipsoid(16.0)
    stress = np.random.default_rng(0).normal(size=(len(mesh.tets), 3, 3))
    stress = stress + stress.transpose(0, 2, 1)
    force = eigenstress_load(mesh, stress)
    assert_allclose(rigid_body_modes(mesh.points).T @ force.ravel(), 0, atol=1e-8)


@pytest.mark.parametrize("poisson", [0.35, 0.45])
def test_multigrid_agrees_with_the_factorization(poisson: float) -> None:
    mesh = ellipsoid(11.0)
    tissue = Tissue(poisson=poisson)
    held = np.flatnonzero(mesh.points[:, 2] < -55)
    free = np.setdiff1d(np.arange(len(mesh.points)), held)
    rows = (free[:, None] * 3 + np.arange(3)).ravel()
    matrix = stiffness(mesh, tissue.lame_kpa, tissue.shear_kpa)[rows][:, rows].tocsr()
    right = np.random.default_rng(0).normal(size=len(rows))
    direct = linear_solver(matrix, mesh.points[free])
    iterative = linear_solver(matrix, mesh.points[free], limit=0)
    assert isinstance(iterative, Multigrid)
    exact = direct.solve(right)
    assert_allclose(matrix @ exact, right, atol=1e-9)
    assert_allclose(iterative.solve(right), exact, atol=1e-6 * np.abs(exact).max())
    residuals = np.array(iterative.residuals)
    assert (residuals[-1] / residuals[0]) ** (1 / (len(residuals) - 1)) < 0.5
    many = direct.solve(np.stack([right, 2 * right], 1))
    assert_allclose(many[:, 1], 2 * exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())


def test_a_factor_in_single_precision_leads_to_the_same_answer() -> None:
    mesh = ellipsoid(11.0)
    anchored = stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa) + 1e-3 * identity(3 * len(mesh.points))
    right = np.random.default_rng(0).normal(size=3 * len(mesh.points))
    exact = linear_solver(anchored.tocsr(), mesh.points).solve(right)
    found = solver_for_few(anchored.tocsr(), mesh.points).solve(right)
    assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7])
def test_multigrid_leads_to_the_same_answer_and_to_the_same_bits_every_time(
    tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = ellipsoid(8.0)
    anchored = (stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa) + 1e-3 * identity(3 * len(mesh.points))).tocsr()
    right = np.random.default_rng(0).normal(size=3 * len(mesh.points))
    exact = solver_for_few(anchored, mesh.points).solve(right)
    monkeypatch.setattr(poro.linalg.solver, "ONCE_LIMIT", 0)
    found = solver_for_few(anchored, mesh.points, tolerance=tolerance).solve(right)
    assert_allclose(found, exact, rtol=0, atol=tolerance * np.abs(exact).max())
    assert not np.array_equal(found, exact)
    np.random.seed(1)  # noqa: NPY002 - the generator that pyamg's own defaults draw from
    assert np.array_equal(found, solver_for_few(anchored, mesh.points, tolerance=tolerance).solve(right))


@pytest.mark.parametrize("limit", [0, 10**9])
def test_imposed_displacements_are_continued_as_by_the_factor(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    mesh, rng = ellipsoid(9.0), np.random.default_rng(4)
    held = np.sort(rng.choice(len(mesh.points), 60, replace=False))
    imposed = rng.normal(size=(60, 3))
    exact = solid(mesh, TISSUE, held).solve(np.zeros_like(mesh.points), imposed)
    monkeypatch.setattr(poro.linalg.solver, "ONCE_LIMIT", limit)
    found = continued(mesh, TISSUE, held, imposed)
    assert_array_equal(found[held], imposed)
    assert_allclose(found, exact, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="hold three"):
        continued(mesh, TISSUE, held[:1], imposed[:1])


def test_where_single_precision_does_not_suffice_double_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ellipsoid(25.0)
    matrix = (stiffness(mesh, TISSUE.lame_kpa, TISSUE.shear_kpa) + identity(3 * len(mesh.points))).tocsr()
    right = np.random.default_rng(0).normal(size=3 * len(mesh.points))
    exact = linear_solver(matrix, mesh.points).solve(right)
    monkeypatch.setattr(poro.linalg.solver, "MAX_STEPS", 1)
    single = SingleFactor(matrix, cholesky(matrix, elimination_tree(matrix, mesh.points), 3, np.float32))
    with pytest.raises(SolverError, match="in 1 steps"):
        single.solve(right)
    assert_allclose(solver_for_few(matrix, mesh.points).solve(right), exact, rtol=1e-12)


def test_multigrid_that_runs_out_of_iterations_says_so_with_its_residuals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(poro.linalg.solver, "MAX_ITERATIONS", 3)
    matrix = laplacian(box((12, 12, 12), (30.0, 30.0, 30.0))) + 1e-3 * identity(13**3)
    solver = linear_solver(matrix.tocsr(), np.random.default_rng(0).normal(size=(13**3, 3)), limit=0)
    with pytest.raises(SolverError, match="after 3 iterations") as stopped:
        solver.solve(np.random.default_rng(1).normal(size=13**3))
    residuals = stopped.value.residuals
    assert len(residuals) == 4
    assert residuals[0] == 1
    assert 1e-10 < residuals[-1] < 0.5


def test_a_body_that_its_constraints_leave_free_has_no_answer() -> None:
    mesh = ellipsoid(25.0)
    with pytest.raises(SolverError, match="move freely"):
        solid(mesh, TISSUE, np.zeros(0, int), csr_matrix((3 * len(mesh.points), 3 * len(mesh.points))))


def test_a_body_that_nothing_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="hold three"):
        solid(ellipsoid(25.0), TISSUE, np.array([0]))
