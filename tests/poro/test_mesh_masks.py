"""Lung masks as they come: either side, a thin rim around the diaphragm's dome, noise, islands, holes and stairs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import ndimage

from poro.arrays import Array
from poro.mesh import TetMesh, locate, patches, quality, stuff, surface
from poro.mesh.stuffing import MIN_DIHEDRAL_DEG, signed_distance

SPACING = np.array([1.5, 1.5, 2.5])


def _lung(side: int, dome_mm: float = 45.0) -> tuple[Array, Array]:
    """Mask and affine of a lung 1.2 l in size, its dome `dome_mm` high; side: 1 right, -1 left of the patient."""
    shape = np.array([72, 96, 88])
    affine = np.diag([*SPACING, 1.0])
    affine[:3, 3] = -SPACING * shape / 2
    x, y, z = np.moveaxis(np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * SPACING, -1, 0)
    x, y, z = x + affine[0, 3], y + affine[1, 3], z + affine[2, 3]
    body = (x / 45) ** 2 + (y / 62) ** 2 + ((z + 60) / 150) ** 2 < 1
    heart = np.hypot(np.hypot(side * x + 48, y - 18), z + 30) < 26
    dome = z < -60 + dome_mm * (1 - ((x / 47) ** 2 + (y / 65) ** 2))
    return body & ~heart & ~dome, affine


def _inside(mask: Array, affine: Array) -> Array:
    return np.argwhere(mask) @ affine[:3, :3].T + affine[:3, 3]


def _is_a_ball(mesh: TetMesh) -> bool:
    """Whether the surface is closed and without handles; at a rim's edge two elements may touch along a line alone."""
    s = surface(mesh)
    edges = np.sort(s.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    closed = bool((count % 2 == 0).all()) and (count > 2).sum() <= 2
    return closed and len(s.points) - len(edges) + len(s.triangles) == 2


@pytest.mark.parametrize("dome", [20.0, 45.0, 70.0])
def test_thin_rims_are_meshed_within_the_angle_bound(dome: float) -> None:
    """The higher the dome the thinner its rim: what is thinner than an element is lost, less of it on finer ones."""
    mask, affine = _lung(1, dome)
    lost = []
    for edge in (8.0, 5.0):
        mesh = stuff(mask, affine, edge)
        assert quality(mesh).min_dihedral >= MIN_DIHEDRAL_DEG
        assert _is_a_ball(mesh)
        away = locate(mesh, _inside(mask, affine)).distance
        assert (away > edge / 2).mean() < 0.025
        assert (away > 1.5 * edge).mean() < 0.01
        lost.append(1 - mesh.volumes.sum() / (mask.sum() * SPACING.prod()))
    assert 0 < lost[1] < 0.7 * lost[0] < 0.04


def test_the_left_lung_is_the_right_one_mirrored() -> None:
    mirror = np.array([-1.0, 1, 1])
    (right_mask, affine), (left_mask, _) = _lung(1), _lung(-1)
    right, left = stuff(right_mask, affine, 7.0), stuff(left_mask, affine, 7.0)
    assert right.volumes.sum() == pytest.approx(left.volumes.sum(), rel=0.01)
    centres = [np.average(m.points, axis=0, weights=m.node_volumes) for m in (right, left)]
    assert_allclose(centres[0] * mirror, centres[1], atol=0.8)
    for side, mesh in ((1, right), (-1, left)):
        found = patches(mesh.boundary, np.array([[-side * 30.0, 0, 30]]))
        normals = mesh.boundary.node_normals
        assert (side * normals[found.mediastinal, 0] < 0).all()
        assert normals[found.diaphragm, 2].max() < 0
        assert mesh.boundary.node_areas[found.mediastinal].sum() > 0.05 * mesh.boundary.areas.sum()


def _noisy(mask: Array) -> Array:
    """A tenth of the voxels next to the border flipped."""
    ring = ndimage.binary_dilation(mask) & ~ndimage.binary_erosion(mask)
    return mask ^ (ring & (np.random.default_rng(0).random(mask.shape) < 0.1))


def _islands(mask: Array) -> Array:
    """Three lumps of air beside the lung."""
    dirty = mask.copy()
    for x, y, z in ((3, 5, 4), (66, 90, 80), (4, 90, 40)):
        dirty[x : x + 5, y : y + 5, z : z + 4] = True
    return dirty


def _holes(mask: Array) -> Array:
    """Vessels of a voxel or two that a threshold left out."""
    dirty = mask.copy()
    dirty[30:31, 30:60, 50:51] = False
    dirty[40, 48, 40:60] = False
    return dirty & (np.random.default_rng(1).random(mask.shape) > 0.01)


def _stairs(mask: Array) -> Array:
    """Every third slice, three times."""
    return mask[:, :, (np.arange(mask.shape[2]) // 3) * 3]


@pytest.mark.parametrize("spoil", [_noisy, _islands, _holes, _stairs])
def test_dirty_masks_give_the_mesh_of_the_clean_one(spoil) -> None:  # type: ignore[no-untyped-def]
    mask, affine = _lung(1)
    clean, mesh = stuff(mask, affine, 7.0), stuff(spoil(mask), affine, 7.0)
    assert quality(mesh).min_dihedral >= MIN_DIHEDRAL_DEG
    assert _is_a_ball(mesh)
    assert mesh.volumes.sum() == pytest.approx(clean.volumes.sum(), rel=0.04)
    assert locate(clean, mesh.points).distance.max() < 7.0
    assert np.quantile(locate(clean, mesh.points).distance, 0.95) < 2.5


@pytest.mark.parametrize("edge_mm", [8.0, 11.0, 14.0])
def test_a_mesh_lies_where_its_mask_does_however_many_voxels_are_averaged(edge_mm: float) -> None:
    """Voxels of 1.2, 1.6 and 2 mm: two, an odd and an even number of them lie in a quarter of an edge."""
    spacing, centre = np.array([1.2, 1.6, 2.0]), np.array([12.0, -8.0, 20.0])
    shape = np.ceil(90.0 / spacing).astype(int)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = centre - spacing * (shape - 1) / 2
    x = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * spacing + affine[:3, 3]
    mesh = stuff(np.linalg.norm(x - centre, axis=-1) < 40.0, affine, edge_mm)
    middle = np.average(mesh.points, axis=0, weights=mesh.node_volumes)
    assert_allclose(middle, centre, atol=0.3)


@pytest.mark.parametrize("width", [np.zeros((3, 2), int), np.array([[9, 30], [17, 4], [23, 11]])])
def test_what_lies_about_a_mask_does_not_change_its_distances(width: Array) -> None:
    """Only the mask's box is averaged over."""
    mask, affine = _lung(1)
    cut = tuple(slice(w[0] - 3, w[-1] + 4) for w in (np.unique(axis) for axis in np.nonzero(mask)))
    first = np.array([c.start for c in cut])
    near = affine.copy()
    near[:3, 3] += affine[:3, :3] @ first
    far = near.copy()
    far[:3, 3] -= affine[:3, :3] @ width[:, 0]
    alone, there = signed_distance(mask[cut], near, 2.0, 1.6)
    found, same = signed_distance(np.pad(mask[cut], width), far, 2.0, 1.6)
    assert_allclose(same, there)
    assert_allclose(found, alone, atol=1e-9)
