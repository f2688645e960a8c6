"""Refinement by small blocks: what is left between the CT, carried by a result, and a cone-beam CT is measured all over
the lung, right up to the pleura, and followed elastically.

Vessels reach within a few millimetres of the pleura, but only blocks of 7 to 11 mm that are cut off at the pleura see
them, and such blocks are found only where a map is right to a few millimetres. So this comes last in each phase. Blocks
scatter, and elasticity carries their scatter on, while true motion is smooth: it is smoothed after each pass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from poro.fem import Tissue, prepare_solid
from poro.fit import PointConstraints
from poro.fit.elastic_correction import elastic_pull
from poro.mesh import TetMesh
from poro.mesh.closest import depth_below
from poro.mesh.tetmesh import signed_volumes
from registration.correspondences import Correspondences
from registration.images.morphology import bounding_box, erode
from registration.images.resample import coarsen, resample_mask
from registration.kernels.threads import ahead
from registration.keypoints.aligned_matching import AlignedSettings, Organ, match_aligned, organ_of
from registration.keypoints.matching import MatchSettings, detect_inside
from registration.volume import Array, Mask, Volume
from vatsloc.imaging.cbct import PreparedCbct
from vatsloc.imaging.surface import SPACING_MM, SurfacePoints
from vatsloc.maps import MeshMap
from vatsloc.workflow.hold_out import held_out, too_few
from vatsloc.workflow.settings import RefinementSettings
from vatsloc.workflow.smoothed import Smoother, smoother

PASSES = ((1.5, 6.0), (1.5, 6.0), (1.0, 3.0))
"""Voxels of the blocks and how far they are looked for, mm, pass by pass: more are found where the first ones led."""
SETTLED_MM = 0.65
"""Median misfit at held-out blocks below which voxels of one size do not serve a lung in one piece for another pass.
Beside a cut, what a pass finds leads on to more."""
NO_WORSE = 1.02
"""A pass is followed that leaves at most this much more of the misfit at held-out blocks. They judge a lung that
followed only three quarters of what the answer follows."""
MARGIN_MM = 16.0
"""What is kept of a scan about the lung: more than a block and its search reach."""
RIM_MM = 2.0
"""What is cut off the lung in both images: nearer than this to its border, voxels also show what lies beyond."""
SIGMA_MM, STRAIN = (1.0, 2.0), 0.02
"""Standard deviation of a block's position, near the pleura and deep below it, and how far tissue gives way to it
(`elastic_correction`) before it is smoothed. Deep in the lung what came before is as sure as a block."""
SHALLOW_MM, DEEP_MM = 8.0, 20.0
"""Where the one ends and the other begins."""
WALL_SIGMA_MM, WALL_REACH_MM, WALL_ALONG = 2.0, 5.0, 0.7
"""Standard deviation of where a lung that fills its cavity touches the wall; how far a node of its surface may be off,
and the least cosine between both normals: beyond, the nearest wall is likelier another one."""
ROUNDS = 3
"""How often a lung is drawn to the same blocks and smoothed: where there are none, what others tell comes nearer by a
little each time."""
ANCHOR_SIGMA_MM = 0.2
"""Standard deviation of nodes that other evidence has placed."""
HALVINGS = 20
"""Steps by which nodes of elements that would turn over follow less; in the second half they stay where they are."""
BESIDE_CUT_MM = 3.0
"""A block about a place nearer to a cut than this is as much of the other piece, and is not followed."""
APART_MM = 15.0
"""Blocks are held out by cubes this wide: they are dense, and what they tell does not reach far."""


@dataclass(frozen=True)
class Compared:
    """What is compared. ct, lung_ct: the CT and its lung; scan, lung: a cone-beam CT and the lung found there."""

    ct: Volume
    lung_ct: Mask
    scan: PreparedCbct
    lung: Mask


@dataclass(frozen=True)
class Prospect:
    """What both images tell before a map between them is known. points: (n, 3) distinctive ones of the scan's lung,
    where blocks can be followed; lungs: of each pass, the scan's and the CT's, ready for matching.
    """

    points: Array
    lungs: tuple[tuple[Organ, Organ], ...]


@dataclass(frozen=True)
class Shape:
    """A lung in a scan. rest: undeformed, in the scan's frame; map: from the CT, with the same tetrahedra; anchors:
    (k,) nodes that other evidence has placed; within_mm: how deep below the pleura blocks are followed; wall: what its
    surface touches in the scan, None where it need not touch anything; cut: distance (n,) mm of points (n, 3) of the CT
    from a cut through the lung, None where there is none; piece: (n,) of every node, None for one piece.
    """

    rest: TetMesh
    map: MeshMap
    anchors: Array
    within_mm: float = float("inf")
    wall: SurfacePoints | None = None
    cut: Callable[[Array], Array] | None = None
    piece: Array | None = None

    def moved(self, points: Array) -> Shape:
        """The same lung with its nodes at points (n, 3) mm of the scan."""
        return replace(self, map=replace(self.map, moved=points))


@dataclass(frozen=True)
class Pass:
    """One pass. voxel_mm: of the blocks; blocks: how many were found; before_mm, after_mm: median misfit at held-out
    ones, without and with following the others; kept: whether the lung followed.
    """

    voxel_mm: float
    blocks: int
    before_mm: float
    after_mm: float
    kept: bool

    @property
    def settled(self) -> bool:
        """Whether the lung followed, to all that voxels of this size tell."""
        return self.kept and self.after_mm < SETTLED_MM


@dataclass(frozen=True)
class BlockRefinement:
    """A lung that followed blocks. points: (n, 3) mm, its nodes in the scan; passes: what each found and did; followed:
    the blocks that it followed in the end, from the CT (`moving`) to the scan (`fixed`), None where it did not.
    """

    points: Array
    passes: tuple[Pass, ...]
    followed: Correspondences | None = None


def refine_by_blocks(prospect: Prospect, shape: Shape) -> BlockRefinement:
    """Nodes of a lung moved to where small blocks of the CT are found in a scan, smoothed; as they were where held-out
    blocks judge badly.

    Until the last pass held-out blocks are not followed, then all are, from what the passes before left.
    """
    starts = _within_reach(prospect.points, shape)
    smooth = ahead(partial(_smoother, shape))
    passes: list[Pass] = []
    trial, answer = shape, None
    for lungs, (voxel_mm, reach_mm) in zip(prospect.lungs, PASSES, strict=True):
        if passes and passes[-1].settled and passes[-1].voxel_mm == voxel_mm and shape.cut is None:
            continue
        back = trial.map.inverse().linearized
        matches = match_aligned(*lungs, starts, back, AlignedSettings(reach_mm))
        depth = depth_below(shape.map.mesh.boundary, matches.moving)
        used = depth <= shape.within_mm
        if shape.cut is not None:
            used &= np.abs(shape.cut(matches.moving)) >= BESIDE_CUT_MM
        matches, depth = matches.only(used), depth[used]
        if too_few(matches):
            break
        hidden = held_out(matches.fixed, APART_MM)
        whole: Callable[[], Shape] = partial(_followed, trial, matches, depth, smooth())
        if (voxel_mm, reach_mm) == PASSES[-1]:
            whole = ahead(whole)
        tested, followed = matches.only(hidden), _followed(trial, matches.only(~hidden), depth[~hidden], smooth())
        before, after = _misfit(trial, tested), _misfit(followed, tested)
        passes.append(Pass(voxel_mm, len(matches), before, after, after < NO_WORSE * before))
        if passes[-1].kept:
            trial, answer = followed, (whole, matches)
    if answer is None:
        return BlockRefinement(shape.map.moved, tuple(passes))
    whole, matches = answer
    return BlockRefinement(whole().map.moved, tuple(passes), matches)


def _smoother(shape: Shape) -> Smoother:
    """Of the lung before it moved."""
    mesh = shape.map.mesh
    piece = np.zeros(len(mesh.points), dtype=int) if shape.piece is None else shape.piece
    return smoother(mesh, piece, shape.anchors)


def _around(compared: Compared) -> Compared:
    """The scan cut to its lung, the CT to the lung there, and of the lungs what lies deeper than RIM_MM."""
    scan, ct = compared.scan, compared.ct
    lung = resample_mask(compared.lung, scan.volume.grid)
    lung = Mask(lung.inside & scan.field.usable.inside, lung.ras_from_ijk)
    if not lung.inside.any():
        return replace(compared, lung=lung)
    margin = np.ceil(MARGIN_MM / lung.grid.spacing).astype(int)
    cut = bounding_box(lung.inside, margin)
    lung_ct = resample_mask(compared.lung_ct, ct.grid)
    cut_ct = bounding_box(lung_ct.inside, np.ceil(MARGIN_MM / ct.grid.spacing).astype(int))
    inner, inner_ct = (
        Mask(erode(mask.inside, RIM_MM, mask.grid.spacing), mask.ras_from_ijk)
        for mask in (lung.part(cut), lung_ct.part(cut_ct))
    )
    return Compared(ct.part(cut_ct), inner_ct, replace(scan, volume=scan.volume.part(cut)), inner)


def prospect(compared: Compared, rest: TetMesh, settings: RefinementSettings) -> Prospect:
    """What can be made ready before a map from the CT to the scan is known; at most one point a cell. rest: as in
    `Shape`.
    """
    prepare_solid(rest, Tissue())
    around = _around(compared)
    lungs = {mm: (coarsen(around.scan.volume, mm), coarsen(around.ct, mm)) for mm, _ in PASSES}
    made = {
        mm: (
            organ_of(scan, resample_mask(around.lung, scan.grid)),
            organ_of(ct, resample_mask(around.lung_ct, ct.grid)),
        )
        for mm, (scan, ct) in lungs.items()
    }
    organs = tuple(made[mm] for mm, _ in PASSES)
    image, inside = lungs[PASSES[0][0]][0], organs[0][0].image.inside
    if not inside.any():
        return Prospect(np.zeros((0, 3)), organs)
    match = MatchSettings(voxel_mm=PASSES[0][0], cell_mm=settings.cell_mm)
    return Prospect(image.grid.to_ras(detect_inside(image, inside, match).astype(float)), organs)


def _within_reach(points: Array, shape: Shape) -> Array:
    """Those of points (n, 3) of the scan whose blocks may lie no deeper than a lung is to follow them."""
    if np.isinf(shape.within_mm):
        return points
    at = shape.map.inverse()(points)
    return np.asarray(points[depth_below(shape.map.mesh.boundary, at) <= shape.within_mm + PASSES[0][1]])


def _followed(shape: Shape, matches: Correspondences, depth: Array, smooth: Smoother) -> Shape:
    """The lung after it followed matches at depth (n,) mm below the pleura, was smoothed, round after round, and
    followed its wall.
    """
    anchors, rest = shape.anchors, shape.rest
    at = MeshMap(shape.map.mesh, rest.points, shape.map.around)(matches.moving)
    wanted = PointConstraints(
        np.concatenate([at, rest.points[anchors]]),
        np.concatenate([matches.fixed - shape.map(matches.moving), np.zeros((len(anchors), 3))]),
        np.concatenate([np.interp(depth, (SHALLOW_MM, DEEP_MM), SIGMA_MM), np.full(len(anchors), ANCHOR_SIGMA_MM)]),
        np.zeros((len(at) + len(anchors), 3)),
    )
    pull, left = elastic_pull(rest, Tissue(), wanted, STRAIN), wanted.offset
    for _ in range(ROUNDS):
        before = shape.map.moved
        shape = _unturned(shape, smooth(before + pull(left)))
        left = left - pull.operator @ (shape.map.moved - before)
    return _beside_wall(shape)


def _beside_wall(shape: Shape) -> Shape:
    """The lung with its surface drawn to the wall; what lies deeper than SHALLOW_MM stays."""
    rest, (nodes, gap, normals) = shape.rest, _off_wall(shape)
    if len(nodes) == 0:
        return shape
    deep = np.flatnonzero(shape.map.mesh.node_depths > SHALLOW_MM)
    still = np.zeros((len(deep), 3))
    wanted = PointConstraints(
        rest.points[np.concatenate([deep, nodes])],
        np.concatenate([still, gap[:, None] * normals]),
        np.concatenate([np.full(len(deep), ANCHOR_SIGMA_MM), np.full(len(nodes), WALL_SIGMA_MM)]),
        np.concatenate([still, normals]),
    )
    return _unturned(shape, shape.map.moved + elastic_pull(rest, Tissue(), wanted, STRAIN)(wanted.offset))


def _unturned(shape: Shape, points: Array) -> Shape:
    """The lung with its nodes at points (n, 3) mm, or as near to them as turns no element over."""
    now = shape.map.moved
    return shape.moved(now + unfolded(now, points - now, shape.rest.tets))


def _off_wall(shape: Shape) -> tuple[Array, Array, Array]:
    """Nodes (k,) of the lung's surface, how far (k,) mm each is from the wall along its normal (k, 3).

    Their median is taken off: what all share is where either image's border was drawn, not motion.
    """
    if shape.wall is None or len(shape.wall) == 0:
        return np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, 3))
    border, wall = TetMesh(shape.map.moved, shape.map.mesh.tets).boundary, shape.wall
    nearest = cKDTree(wall.points).query(border.points)[1]
    normals = wall.normals[nearest]
    off = wall.points[nearest] - border.points
    gap = np.einsum("nd,nd->n", off, normals)
    facing = np.einsum("nd,nd->n", border.node_normals, normals) > WALL_ALONG
    near = facing & (np.abs(gap) < WALL_REACH_MM) & (np.linalg.norm(off, axis=1) < WALL_REACH_MM + SPACING_MM)
    shared = np.median(gap[near]) if near.any() else 0.0
    return border.nodes[near], gap[near] - shared, normals[near]


def unfolded(points: Array, field: Array, tets: Array) -> Array:
    """Displacements (n, 3) mm of nodes at points (n, 3), made smaller step by step at the nodes of elements that they
    would turn over, until no element turns over that did not before.
    """
    share = np.ones((len(points), 1))
    before = signed_volumes(points, tets) > 0
    for step in range(HALVINGS):
        turns = before & (signed_volumes(points + share * field, tets) <= 0)
        if not turns.any():
            return share * field
        nodes = np.unique(tets[turns])
        share[nodes] *= 0.5 if step < HALVINGS // 2 else 0.0
    return np.zeros_like(field)


def _misfit(shape: Shape, matches: Correspondences) -> float:
    return float(np.median(np.linalg.norm(shape.map(matches.moving) - matches.fixed, axis=1)))
