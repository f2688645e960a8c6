"""A ball of a lung in three frames that are turned against each other: small, and known at every point.

CT -> inflated CBCT is rigid. Inflated -> deflated is rigid, and then the lung alone is squeezed and shifted by an
affine map, which leaves air where it was. All images show one pattern, so that every map has one right answer.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from poro.mesh import TetMesh, stuff_level_set
from registration.maps.bspline import BSplineField
from registration.maps.composite import CompositeTransform
from registration.maps.rigid import RigidTransform
from registration.sliding import SlidingFit
from registration.spine import RigidFit, RigidStatus
from registration.terms.gauss_newton import Stop
from registration.volume import Array, Grid, Mask, Volume
from tests.registration.scenes import make_pattern
from vatsloc.imaging.airways import TrackedAirways
from vatsloc.imaging.cbct import Cupping, FieldOfView, PreparedCbct
from vatsloc.imaging.lungs import Lungs
from vatsloc.imaging.pleura import Pneumothorax
from vatsloc.imaging.side import PleuralGas
from vatsloc.imaging.spine import Spine
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow.prepare import Prepared

CENTRE_CT = np.array([12.0, -8.0, 20.0])
RADIUS_MM = 40.0
SPACING_MM = 2.0
VOXELS = 56
INF_FROM_CT = RigidTransform.about(CENTRE_CT, np.array([0.15, -0.25, 0.3]), np.array([9.0, -14.0, 6.0]))
CENTRE_INF = INF_FROM_CT(CENTRE_CT[None])[0]
DEF_FROM_INF = RigidTransform.about(CENTRE_INF, np.array([-0.3, 0.2, 0.25]), np.array([-12.0, 8.0, 10.0]))
CENTRE_DEF = DEF_FROM_INF(CENTRE_INF[None])[0]
SHIFT_MM = np.array([4.0, -3.0, 5.0])
SQUEEZE = np.array([[0.86, 0.05, 0.0], [-0.03, 0.9, 0.04], [0.02, 0.0, 0.84]])
OTHER_OFFSET, OTHER_RADIUS_MM = np.array([-45.0, 10.0, 5.0]), 10.0
AIRWAY_OFFSET = np.array([-30.0, 5.0, -10.0])
_pattern = make_pattern(seed=9, waves=150, shortest_mm=11.0)


def collapsed(points: Array) -> Array:
    """Where lung tissue that the spine places at points (n, 3) of the deflated CBCT lies after the collapse."""
    return CENTRE_DEF + SHIFT_MM + (points - CENTRE_DEF) @ SQUEEZE.T


def expanded(points: Array) -> Array:
    """The way back."""
    return CENTRE_DEF + (points - CENTRE_DEF - SHIFT_MM) @ np.linalg.inv(SQUEEZE).T


def texture(points_ct: Array) -> Array:
    """HU of lung tissue by its place (n, 3) in the CT: -900 to -450."""
    return np.clip(-720 + 0.4 * (_pattern(points_ct) + 500), -900, -450)


def grid_about(centre: Array, voxels: int = VOXELS, spacing: float = SPACING_MM) -> Grid:
    """voxels^3 along R, A and S about a point."""
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = centre - spacing * (voxels - 1) / 2
    return Grid((voxels, voxels, voxels), affine)


def ball_of(grid: Grid, centre: Array, radius: float = RADIUS_MM) -> Array:
    """Voxels of a grid within a ball."""
    return np.linalg.norm(grid.points() - centre, axis=-1) < radius


def _image(grid: Grid, lung: Array, place_ct: Array, beyond: Array | float) -> Volume:
    """HU of voxels: of lung tissue by its place (n, 3) in the CT, `beyond` elsewhere."""
    hu = np.broadcast_to(beyond, grid.shape).astype(np.float32)
    hu[lung] = texture(place_ct)
    return Volume(hu, grid.ras_from_ijk)


@lru_cache(maxsize=1)
def ct() -> Volume:
    """The CT: the lung in soft tissue of 40 HU."""
    grid = grid_about(CENTRE_CT)
    lung = ball_of(grid, CENTRE_CT)
    return _image(grid, lung, grid.points()[lung], 40.0)


@lru_cache(maxsize=1)
def inflated() -> Volume:
    """The inflated CBCT: the same, moved by INF_FROM_CT."""
    grid = grid_about(CENTRE_INF)
    lung = ball_of(grid, CENTRE_INF)
    return _image(grid, lung, INF_FROM_CT.inverse()(grid.points()[lung]), 40.0)


@lru_cache(maxsize=1)
def deflated() -> Volume:
    """The deflated CBCT: moved by DEF_FROM_INF as well, the lung collapsed in air of -1000 HU."""
    grid = grid_about(CENTRE_DEF)
    before = expanded(grid.points())
    lung = np.linalg.norm(before - CENTRE_DEF, axis=-1) < RADIUS_MM
    back = (DEF_FROM_INF @ INF_FROM_CT).inverse()
    return _image(grid, lung, back(before[lung]), np.where(ball_of(grid, CENTRE_DEF), -1000.0, 40.0))


def lung_deflated() -> Mask:
    """The collapsed lung on the deflated CBCT."""
    grid = deflated().grid
    return Mask(np.linalg.norm(expanded(grid.points()) - CENTRE_DEF, axis=-1) < RADIUS_MM, grid.ras_from_ijk)


@lru_cache(maxsize=2)
def lung_mesh(edge_mm: float = 10.0) -> TetMesh:
    """The lung's tetrahedra in the CT."""
    reach = RADIUS_MM + 3.0
    return stuff_level_set(
        lambda x: RADIUS_MM - np.linalg.norm(x - CENTRE_CT, axis=-1), CENTRE_CT - reach, CENTRE_CT + reach, edge_mm
    )


def placed(mesh_ct: TetMesh, *maps: RigidTransform) -> TetMesh:
    """A mesh of the CT in another frame, moved by one rigid map after the other."""
    points = mesh_ct.points
    for rigid in maps:
        points = rigid(points)
    return TetMesh(points, mesh_ct.tets)


def cbct(volume: Volume, usable: Array | None = None) -> PreparedCbct:
    """An image as `prepare_cbct` leaves it. usable: what was seen of it, by default everything."""
    everything = np.ones(volume.hu.shape, bool)
    seen = Mask(everything if usable is None else usable, volume.ras_from_ijk)
    field = FieldOfView(Mask(everything, volume.ras_from_ijk), seen, np.zeros(2), np.inf, 2)
    return PreparedCbct(volume, field, Cupping(np.zeros(2), np.zeros(2), 1.0, {}, {}))


def empty(volume: Volume) -> Mask:
    """No voxel of an image."""
    return Mask(np.zeros(volume.hu.shape, bool), volume.ras_from_ijk)


def prepared(usable_inflated: Array | None = None, usable_deflated: Array | None = None) -> Prepared:
    """The scene prepared. The right lung is the ball; the left one and the airways are small balls at places of their
    own; every spine is another single voxel.
    """
    image, grid = ct(), ct().grid
    lung, other, airways = (
        Mask(ball_of(grid, CENTRE_CT + offset, radius), grid.ras_from_ijk)
        for offset, radius in ((np.zeros(3), RADIUS_MM), (OTHER_OFFSET, OTHER_RADIUS_MM), (AIRWAY_OFFSET, 8.0))
    )
    spines = []
    for number in range(3):
        bone = empty(image)
        bone.inside[number, 0, 0] = True
        spines.append(Spine(bone, np.zeros((1, 3)), 300.0))
    lungs = Lungs(other, lung, airways, 0.0, {})
    gas = PleuralGas({"left": 1.0, "right": 2.0}, {"left": 3.0, "right": 400.0})
    before, after = cbct(inflated(), usable_inflated), cbct(deflated(), usable_deflated)
    return Prepared(lungs, lung, spines[0], before, spines[1], after, spines[2], gas)


def rigid_fit(moving_from_fixed: RigidTransform) -> RigidFit:
    """A spine registration that found this pose."""
    return RigidFit(moving_from_fixed, RigidStatus.FOUND, 0.9, 0.5, 24.0, 1.0)


def sliding_fit(matched: int, moved_mm: float, moving_from_fixed: Any = None) -> SlidingFit:
    """A registration of the lung of which only its map, by default the identity, and what it began with count."""
    still = CompositeTransform(RigidTransform.identity(), BSplineField(np.zeros((4, 4, 4, 3)), np.eye(4)))
    return SlidingFit(moving_from_fixed or still, Stop.CONVERGED, (), 1.0, 0.0, 1.0, matched, moved_mm, True)


def air_surface(count: int = 600) -> SurfacePoints:
    """Points of the collapsed lung's border, with normals, that all face air."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    unit = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    normals = unit @ np.linalg.inv(SQUEEZE)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = collapsed(CENTRE_DEF + RADIUS_MM * unit)
    return SurfacePoints(points, normals, np.ones(count), np.full(count, Border.AIR, dtype=np.int8))


def pneumothorax() -> Pneumothorax:
    """What is to be found in the deflated CBCT."""
    lung, image = lung_deflated(), deflated()
    space = Mask(ball_of(image.grid, CENTRE_DEF) | lung.inside, image.ras_from_ijk)
    air = Mask(space.inside & ~lung.inside, image.ras_from_ijk)
    tracked = TrackedAirways(empty(image).inside, np.zeros(3), 0.0, 0.0)
    return Pneumothorax(air, lung, space, image, -850.0, 280.0, 90.0, 180.0, tracked)


def inner_nodes(mesh: TetMesh, centre: Array, radius: float) -> Array:
    """Nodes (n,) bool within a ball."""
    return np.asarray(np.linalg.norm(mesh.points - centre, axis=1) < radius)
