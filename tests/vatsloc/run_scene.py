"""A run that can be worked out by hand, for the tests of what a run concludes and writes.

The lung is a ball. One affine map carries it from the CT to the inflated cone-beam CT, another one from there to the
deflated one, and each has its own rigid part. No two images, grids, masks or numbers are alike, so that a thing taken
for another one shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from poro.collapse import PoroState, PoroStatus, Theta
from poro.collapse import StrainMeasure as Strain
from poro.collapse.choice import StrainChoice
from poro.fem import Extrapolation, Flow, Tissue
from poro.fem.extrapolation import ExtrapolationStatus
from poro.fit import Fit, FitStatus
from poro.fit.trust_region import FitStep
from poro.mesh import TetMesh, stuff_level_set
from registration.correspondences import Correspondences
from registration.ffd import FfdFit
from registration.maps.inversion import Inversion
from registration.maps.rigid import RigidTransform
from registration.spine import RigidFit, RigidStatus
from registration.terms.gauss_newton import Stop
from registration.volume import Array, Grid, Mask, Volume
from vatsloc.case import Case, Hints, Nodule
from vatsloc.imaging.cbct import Cupping, FieldOfView, PreparedCbct
from vatsloc.imaging.side import PleuralGas
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow.hilum import HilumMotion, HilumSource
from vatsloc.workflow.model_selection import CollapseModel
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.pneumothorax import Collapse
from vatsloc.workflow.pose import ChangeOfPose
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.residual import Residual


@dataclass(frozen=True)
class Affine:
    """Map x -> matrix x + shift of points (n, 3) in mm."""

    matrix: Array
    shift: Array

    @classmethod
    def about(cls, centre: Array, matrix: Array, shift: Array) -> Affine:
        """Linear map about a point, then a shift."""
        return cls(np.asarray(matrix, float), centre + np.asarray(shift, float) - np.asarray(matrix, float) @ centre)

    def __call__(self, points: Array) -> Array:
        return points @ self.matrix.T + self.shift

    def __matmul__(self, inner: Affine | RigidTransform) -> Affine:
        inner = as_affine(inner)
        return Affine(self.matrix @ inner.matrix, self.matrix @ inner.shift + self.shift)

    def inverse(self) -> Affine:
        """The map back."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.shift)

    @property
    def det(self) -> float:
        """How a volume grows."""
        return float(np.linalg.det(self.matrix))


def as_affine(mapping: Affine | RigidTransform) -> Affine:
    """A rigid map in the same terms."""
    return mapping if isinstance(mapping, Affine) else Affine(mapping.matrix[:3, :3], mapping.matrix[:3, 3])


CENTRE, RADIUS_MM = np.array([60.0, -20.0, 40.0]), 30.0
NODULE_CT = np.add(CENTRE, [18.0, 6.0, -4.0])
NODULE_RADIUS_MM = 7.0

INF_FROM_CT_RIGID = RigidTransform.about(CENTRE, np.array([0.06, -0.1, 0.2]), np.array([8.0, -5.0, 12.0]))
DEF_FROM_INF_RIGID = RigidTransform.about(CENTRE, np.array([-0.15, 0.08, 0.1]), np.array([-6.0, 9.0, 4.0]))
INF_FROM_CT = as_affine(INF_FROM_CT_RIGID) @ Affine.about(
    CENTRE, np.array([[1.1, 0.05, 0], [0, 0.95, -0.04], [0.06, 0, 1.04]]), np.array([1.5, -2.0, 1.0])
)
HILUM_INF = INF_FROM_CT(CENTRE - [28.0, 0, 0])
DEF_FROM_INF = as_affine(DEF_FROM_INF_RIGID) @ Affine.about(
    HILUM_INF, np.array([[0.45, 0.08, 0], [0, 0.7, 0.1], [-0.05, 0, 0.6]]), np.array([-9.0, 2.0, -1.0])
)
DEF_FROM_CT, DEF_FROM_CT_RIGID = DEF_FROM_INF @ INF_FROM_CT, DEF_FROM_INF_RIGID @ INF_FROM_CT_RIGID
AFTER_FROM_BEFORE = DEF_FROM_INF @ DEF_FROM_INF_RIGID.inverse()
NODULE_INF, NODULE_DEF = INF_FROM_CT(NODULE_CT), DEF_FROM_CT(NODULE_CT)

CT_HU = np.array([3.0, -2.0, 1.5])  # per mm
PRESSURE, CONTACT = np.array([0.002, 0.003, -0.001]), np.array([-0.004, 0.001, 0.002])  # kPa per mm
COVARIANCE = np.array([[1.6, 0.4, -0.8], [0.4, 1.2, 0.2], [-0.8, 0.2, 2.0]])
OFF_SURFACE_MM = np.array([-2.0, 0.5, 1.5, -1.75, 4.0])


def ct_hu(points: Array) -> Array:
    """What the CT shows at points (..., 3) inside it."""
    return -400 + (points - CENTRE) @ CT_HU


def pressure(points: Array) -> Array:
    """Of the model, kPa, at points (..., 3) before the collapse."""
    return 0.1 + (points - CENTRE) @ PRESSURE


def contact(points: Array) -> Array:
    """Contact pressure, likewise."""
    return 0.3 + (points - CENTRE) @ CONTACT


def jacobian(points: Array) -> Array:
    """Motion (n, 3, 3) of points (n, 3) before the collapse per unit of each parameter."""
    x = (points - CENTRE) / 30.0
    each = (
        np.add(x, [1.0, 0, 2.0]),
        np.add(0.5 * x[:, [1, 2, 0]], [0, -1.5, 0]),
        np.add(x[:, [2, 0, 1]], [0.5, 1, -1]),
    )
    return np.stack(each, axis=2)


def lps_grid(shape: tuple[int, int, int], spacing: tuple[float, float, float], centre: Array) -> Grid:
    """Voxels along LPS about a point."""
    affine = np.diag([-spacing[0], -spacing[1], spacing[2], 1.0])
    affine[:3, 3] = centre - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    return Grid(shape, affine)


def ball(grid: Grid, centre: Array, radius_mm: float) -> Mask:
    """Voxels near a point."""
    return Mask(np.linalg.norm(grid.points() - centre, axis=-1) <= radius_mm, grid.ras_from_ijk)


def ball_mesh(centre: Array, radius_mm: float, edge_mm: float) -> TetMesh:
    """Tetrahedra that fill a ball."""

    def depth_mm(points: Array) -> Array:
        return radius_mm - np.linalg.norm(points - centre, axis=-1)

    margin = radius_mm + 5
    return stuff_level_set(depth_mm, centre - margin, centre + margin, edge_mm)


CT_GRID = lps_grid((38, 36, 40), (3.0, 3.2, 2.9), np.add(CENTRE, [2.0, 1.0, -1.0]))
INFLATED_GRID = lps_grid((30, 31, 29), (3.4, 3.1, 3.6), np.add(INF_FROM_CT(CENTRE), [1.0, -2.0, 3.0]))
DEFLATED_GRID = lps_grid((46, 44, 42), (2.3, 2.5, 2.4), DEF_FROM_CT_RIGID(CENTRE[None])[0] + [-3.0, 2.0, 1.0])


@dataclass(frozen=True)
class Scene:
    """All that a run has found before it concludes."""

    case: Case
    prepared: Prepared
    pose: ChangeOfPose
    collapse: Collapse

    def with_model(self, **changes: Any) -> Scene:
        """With another outcome of the model."""
        return self.with_collapse(model=replace(self.collapse.model, **changes))

    def with_fit(self, **changes: Any) -> Scene:
        """With another fit."""
        return self.with_model(fit=replace(self.collapse.fit, **changes))

    def with_observed(self, **changes: Any) -> Scene:
        """With other observations of the deflated lung."""
        return self.with_collapse(observed=replace(self.collapse.observed, **changes))

    def with_collapse(self, **changes: Any) -> Scene:
        """With another collapse."""
        return replace(self, collapse=replace(self.collapse, **changes))

    def with_pose(self, **changes: Any) -> Scene:
        """With another change of pose."""
        return replace(self, pose=replace(self.pose, **changes))


@lru_cache(maxsize=1)
def scene() -> Scene:
    """The run, without a residual registration and without keypoints."""
    lung = ball_mesh(CENTRE, RADIUS_MM, 12.0)
    return Scene(_case(), _prepared(), _pose(lung), _collapse(lung))


def _case() -> Case:
    rng = np.random.default_rng(1)
    inflated, deflated = (
        Volume(rng.normal(-500, 300, grid.shape).astype(np.float32), grid.ras_from_ijk)
        for grid in (INFLATED_GRID, DEFLATED_GRID)
    )
    return Case(
        folder=Path("case"),
        side="right",
        ct=Volume(ct_hu(CT_GRID.points()).astype(np.float32), CT_GRID.ras_from_ijk),
        cbct_inflated=inflated,
        cbct_deflated=deflated,
        nodule=Nodule(NODULE_CT, ball(CT_GRID, NODULE_CT, NODULE_RADIUS_MM)),
        gravity_ras=np.array([-0.6, 0.0, 0.8]),
        pleural_gas="air",
        hints=Hints(),
        input_sha256={"ct": "c0", "cbct_inflated": "1f", "cbct_deflated": "de"},
        stored_axes={"ct": "RAS", "cbct_inflated": "LPS", "cbct_deflated": "SAL"},
    )


def cbct(grid: Grid, usable: Mask, hu: float) -> PreparedCbct:
    """A cone-beam CT of one value that was seen everywhere; usable: what of it may be used."""
    everywhere = Mask(np.ones(grid.shape, bool), grid.ras_from_ijk)
    seen = FieldOfView(everywhere, usable, np.zeros(2), np.inf, 2)
    removed = Cupping(np.array([0.0, 50.0]), np.array([hu, 0.0]), 0.9, {"air": hu}, {"air": hu - 1})
    return PreparedCbct(Volume(np.full(grid.shape, hu, np.float32), grid.ras_from_ijk), seen, removed)


GAS = PleuralGas({"left": 5.0, "right": 6.0}, {"left": 7.0, "right": 800.0})


def _prepared() -> Prepared:
    unused: Any = None
    return Prepared(
        lungs=unused,
        lung_ct=ball(CT_GRID, CENTRE, RADIUS_MM),
        inflated=cbct(INFLATED_GRID, ball(INFLATED_GRID, NODULE_INF, 25.0), 11.0),
        deflated=cbct(DEFLATED_GRID, ball(DEFLATED_GRID, NODULE_DEF, 20.0), 22.0),
        spine_ct=unused,
        spine_inflated=unused,
        spine_deflated=unused,
        gas=GAS,
    )


def _pose(lung: TetMesh) -> ChangeOfPose:
    n = len(lung.points)
    unused: Any = None
    numbers = np.arange(n)
    return ChangeOfPose(
        rigid=RigidFit(INF_FROM_CT_RIGID.inverse(), RigidStatus.FOUND, 0.81, 0.6, 24.0, 0.93),
        ffd=FfdFit(unused, Stop.SMALL_STEP, (), 0.31, 0.011, 1.0),
        lung_inf=ball(INFLATED_GRID, INF_FROM_CT(CENTRE), 28.0),
        mesh_ct=lung,
        points_inf=INF_FROM_CT(lung.points),
        seen=numbers % 3 > 0,
        inversion=Inversion(INF_FROM_CT(lung.points), np.where(numbers % 3 > 0, 0.001, 5.0) * numbers, 7),
        extrapolation=Extrapolation(
            np.zeros((n, 3)), np.array([0.42, 0.9]), np.array([1, 4]), 2, ExtrapolationStatus.RELEASED
        ),
        overlap=0.63,
    )


def _collapse(lung: TetMesh) -> Collapse:
    before = TetMesh(DEF_FROM_INF_RIGID(INF_FROM_CT(lung.points)), lung.tets)
    model_mesh = ball_mesh(before.points.mean(axis=0), 48.0, 24.0)
    after = TetMesh(AFTER_FROM_BEFORE(before.points), lung.tets)
    solid = StrainChoice(_state(model_mesh), Strain.LINEAR, "strains little", 0.0004, None)
    system: Any = SimpleNamespace(mesh=model_mesh, modes=(), flow=Flow(model_mesh, Tissue()))
    nothing = np.zeros((0, 3))
    found: Any = SimpleNamespace(is_collapsed=True, lung=ball(DEFLATED_GRID, DEF_FROM_CT(CENTRE), 18.0))
    unused: Any = None
    observed = Observed(
        rigid=RigidFit(DEF_FROM_INF_RIGID.inverse(), RigidStatus.AMBIGUOUS, 0.72, 0.65, 30.0, 0.88),
        found=found,
        surface=observed_surface(after),
        mesh_before=before,
        model_mesh=model_mesh,
        hilum=unused,
        hilum_nodes=np.array([2, 3]),
        motion=HilumMotion(np.array([[1.0, 2, 3], [3.0, 6, 5]]), HilumSource.AIRWAYS),
    )
    matched, ensemble = Correspondences.of(nothing, nothing), np.zeros((0, *model_mesh.points.shape))
    still = np.zeros_like(model_mesh.points)
    model = CollapseModel(system, _fit(model_mesh), still, matched, (), solid, ensemble)
    return Collapse(observed, model, None, after.points)


def observed_surface(after: TetMesh, keep: Array | slice = slice(None)) -> SurfacePoints:
    """Air seen OFF_SURFACE_MM from five of the collapsed lung's triangles; 2 points of fissures, 3 of contact, 4 dense
    ones, all 50 mm off. keep: which triangles may be taken.
    """
    skin = after.boundary
    chosen = np.arange(len(skin.triangles))[keep][:: len(skin.triangles) // 12][:5]
    centres = skin.points[skin.triangles[chosen]].mean(axis=1)
    air = centres + OFF_SURFACE_MM[:, None] * skin.normals[chosen]
    far = np.tile(np.add(after.points.mean(axis=0), [0, 0, 90.0]), (9, 1))
    kinds = np.repeat([Border.AIR, Border.FISSURE, Border.CONTACT, Border.DENSE], [5, 2, 3, 4])
    normals = np.tile([0.0, 0, 1], (14, 1))
    return SurfacePoints(np.concatenate([air, far]), normals, np.ones(14), kinds.astype(np.int8))


def _state(mesh: TetMesh) -> PoroState:
    n = len(mesh.points)
    unused: Any = None
    return PoroState(
        theta=Theta(2e-8, 0.7, 11.0),
        u=np.zeros((n, 3)),
        p=pressure(mesh.points),
        contact_pressure=contact(mesh.points),
        det_f=np.linspace(0.37, 0.8, len(mesh.tets)),
        gap=np.zeros(n),
        active=np.arange(n) < 13,
        iterations=6,
        conflicts=0,
        status=PoroStatus.SOLVED,
        contact=unused,
    )


def _fit(mesh: TetMesh) -> Fit:
    state = _state(mesh)
    return Fit(
        theta=state.theta,
        state=state,
        covariance=COVARIANCE,
        sensitivity=jacobian(mesh.points),
        surface_rms_mm=1.7,
        keypoint_rms_mm=2.3,
        history=4 * (FitStep(1.0, 1.0, state.theta.vector(), True),),
        costs=np.array([1.0]),
        status=FitStatus.CONVERGED,
        free=np.ones(3, bool),
    )


def modelled(points: Array, unexplained_mm: float | Array) -> Array:
    """Covariance (n, 3, 3) of points (n, 3) before the collapse: the fit's, and what it does not explain."""
    j = jacobian(points)
    square = np.broadcast_to(np.square(unexplained_mm), (len(points),))
    return np.array([a @ COVARIANCE @ a.T + b * np.eye(3) for a, b in zip(j, square, strict=True)])


def corrected(lung: TetMesh) -> Residual:
    """A residual registration that looked at 40 nodes and believed 30 of them, which it moved by 2.5 mm per axis."""
    numbers = np.arange(len(lung.points))
    compared, seen = numbers < 40, numbers < 30
    moved = np.where(seen[:, None], [-2.5, 2.5, -2.5], 40.0)
    return Residual(moved, compared, seen, np.where(seen, 0.1 * numbers, 30.0), 0.55)
