"""Noise-free images of a thorax in a state: walls carried by the cage's motion, lung by its own map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from phantoms.cage import CageMotion
from phantoms.fields import Lattice, coverage, refine, smoothstep
from phantoms.lobes import LobedMap
from phantoms.nodule import PLAIN_HU
from phantoms.patient import Patient
from phantoms.spline import SplineMap
from phantoms.thorax import draw_lung_trees
from phantoms.trees import LungTrees
from phantoms.voxels import Grid, Image, Region

Array = NDArray[Any]
PLEURAL_AIR_HU = -998.0
AIRLESS_HU, FLUID_HU = 28.0, 12.0
FADE_MM = 3.0
"""Standard deviation of the blur in which vessels of scanned tissue fade."""


@dataclass(frozen=True)
class Look:
    """How a collapsed lung looks beside its shape. airless: on a lattice in the CT, 1 where tissue holds no gas, 0
    where it does, or None; vessels: their radii over those in the CT; down, level: (3,) unit vector in the CT's frame
    and mm along it, beyond which fluid fills what gas else would."""

    airless: Lattice | None = None
    vessels: float = 1.0
    down: Array | None = None
    level: float = np.inf


@dataclass(frozen=True)
class State:
    """A thorax on the table. lung: operated lung in the CT; cavity: its room in the state, both signed distances (mm);
    motion: CT to the state for the walls; lung_map: CT to the state for the operated lung; held: whether the lung fills
    its room; pose: (4, 4), frame of the state's image from that of the CT; samples: (n, 3) mm in the lung in the CT;
    look: of the lung."""

    lung: Lattice
    cavity: Lattice
    motion: CageMotion
    lung_map: LobedMap
    held: bool
    pose: Array
    samples: Array
    look: Look = field(default_factory=Look)

    def from_ct(self, points: Array) -> Array:
        """Where lung tissue at CT points (n, 3) is in the state's image frame, RAS mm."""
        return self.posed(self.lung_map(points))

    def to_ct(self, points: Array) -> tuple[Array, Array]:
        """CT points (n, 3) of lung tissue at points (n, 3) of the state's image frame, and what is left, (n,) mm."""
        return self.lung_map.inverse(self.unposed(points), self.samples)

    def posed(self, points: Array) -> Array:
        """Points (n, 3) of the CT's frame in the state's image frame."""
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]

    def unposed(self, points: Array) -> Array:
        """Points (n, 3) of the state's image frame in the CT's frame."""
        return (points - self.pose[:3, 3]) @ self.pose[:3, :3]


@dataclass(frozen=True)
class Picture:
    """Noise-free image of a state with masks of the operated lung and of the nodule."""

    clean: Image
    lung: Region
    nodule: Region


def image_state(patient: Patient, body: Image, state: State, grid: Grid) -> Picture:
    """Image of a state on `grid`. body: the CT without its operated lung (HU)."""
    width = float(grid.spacing.mean())
    x = np.stack([a.ravel() for a in np.moveaxis(state_points(state, grid), -1, 0)], axis=1)
    hu = _walls(body, state, grid)
    room = coverage(state.cavity.sample(x), width)
    within = np.flatnonzero(room > 0)
    look = state.look
    drowned = np.zeros(len(within), dtype=bool) if look.down is None else x[within] @ look.down > look.level
    del x
    source, ratio, share = _lung_sources(state, grid, within)
    if state.held:
        share = np.ones_like(share)
    lesion = coverage(patient.nodule.distance(source) * np.cbrt(ratio), width) * share
    resting = _resting(patient, state, source, lesion)
    tissue = np.minimum((resting + 1000) / ratio - 1000, 40.0)
    if look.airless is not None:
        tissue += look.airless.sample(source) * (AIRLESS_HU - tissue)
    gas = np.where(drowned, FLUID_HU, PLEURAL_AIR_HU)
    # Lung that lies against the wall fills all of the room that a voxel has, not a share of that share.
    inner = gas + np.minimum(share / room[within], 1) * (tissue - gas)
    flat = hu.ravel()
    flat[within] += room[within] * (inner - flat[within])
    if patient.trees is not None:
        plain = flat[within].copy()
        draw_lung_trees(hu, carry_trees(patient.trees, state), grid, width)
        if patient.nodule.shown(state.held):
            flat[within] += lesion * room[within] * (plain - flat[within])
    lung, nodule = np.zeros(hu.size, dtype=bool), np.zeros(hu.size, dtype=bool)
    lung[within] = (share > 0.5) & (room[within] > 0.5)
    nodule[within] = lesion > 0.5
    affine = grid.ras_from_ijk
    return Picture(
        Image(hu, affine), Region(lung.reshape(grid.shape), affine), Region(nodule.reshape(grid.shape), affine)
    )


def _resting(patient: Patient, state: State, source: Array, lesion: Array) -> Array:
    """HU (n,) of the lung at points (n, 3) in the CT, as it would be there if it were then as in the state: vessels
    faded, nodule (share of each point in it) shown or not."""
    nodule, shown = patient.nodule, patient.nodule.shown(state.held)
    resting = patient.tissue(source)
    if patient.trees is None and state.look.vessels < 1:
        tissue = patient.parenchyma
        plain = tissue.like(ndimage.gaussian_filter(tissue.values, FADE_MM / tissue.spacing)).sample(source)
        resting += (1 - state.look.vessels) * (plain - resting)
    if nodule.kind != "given" and shown:
        resting += lesion * (nodule.density(source) - resting)
    if nodule.kind == "given" and not shown:
        resting += lesion * (PLAIN_HU - resting)
    return resting


def state_points(state: State, grid: Grid) -> Array:
    """Voxel centres in the frame of the CT, mm, (ni, nj, nk, 3)."""
    affine = np.linalg.inv(state.pose) @ grid.ras_from_ijk
    return Grid(grid.shape, affine).points().astype(np.float32)


def carry_trees(trees: LungTrees, state: State) -> LungTrees:
    """Trees of the operated lung in the state's image frame; what lies in the mediastinum moves with it."""
    moved = []
    # What keeps an airway open is stiffer than a vessel.
    widths = (np.sqrt(state.look.vessels), state.look.vessels, state.look.vessels)
    for tree, width in zip((trees.airway, trees.artery, trees.vein), widths, strict=True):
        outside = smoothstep(state.lung.at(tree.nodes), 0, 12)[:, None]
        inside = state.lung_map(tree.nodes)
        moved.append(tree.moved(state.posed(inside + outside * (state.motion(tree.nodes) - inside)), float(width)))
    return LungTrees(*moved)


def _coarse(grid: Grid, step_mm: float) -> tuple[Grid, int]:
    step = max(int(step_mm / grid.spacing.min()), 1)
    affine = grid.ras_from_ijk @ np.diag([step, step, step, 1])
    n = [(s - 1) // step + 2 for s in grid.shape]
    return Grid((n[0], n[1], n[2]), affine), step


def _walls(body: Image, state: State, grid: Grid) -> Array:
    coarse, step = _coarse(grid, 7.0)
    points = state.unposed(coarse.points().reshape(-1, 3))
    source = body.grid.to_ijk(state.motion.inverse(points, 0.02)).reshape(*coarse.shape, 3)
    index = np.stack([refine(source[..., m], step, grid.shape) for m in range(3)])
    return ndimage.map_coordinates(body.hu, index, order=1, mode="nearest", prefilter=False)


def _lung_sources(state: State, grid: Grid, within: Array) -> tuple[Array, Array, Array]:
    """CT points (n, 3) of the voxels `within` (flat indices) and volume ratios (n,) by the lobe that a voxel lies
    deepest in, continued beyond the lung, and the share (n,) of a voxel that all lobes fill together."""
    coarse, step = _coarse(grid, 4.5)
    x = state.unposed(coarse.points().reshape(-1, 3))
    room = state.cavity.sample(x) < 2.0 * step * grid.spacing.max()
    source, ratio = np.zeros((len(within), 3), dtype=np.float32), np.ones(len(within), dtype=np.float32)
    edge, share = np.full(len(within), np.inf, dtype=np.float32), np.zeros(len(within), dtype=np.float32)
    for piece, region in zip(state.lung_map.pieces, state.lung_map.lobes.regions, strict=True):
        samples = state.samples[region.sample(state.samples) < 6.0]
        fields = _piece_sources(piece, samples, x, room).reshape(*coarse.shape, 4)
        fine = np.stack([refine(fields[..., m], step, grid.shape).ravel()[within] for m in range(4)], axis=1)
        distance = region.sample(fine[:, :3]) * np.cbrt(fine[:, 3])
        share += coverage(distance, float(grid.spacing.mean()))
        deeper = distance < edge
        source[deeper], ratio[deeper], edge[deeper] = fine[deeper, :3], fine[deeper, 3], distance[deeper]
    return source, ratio, np.minimum(share, 1.0)


def _piece_sources(piece: SplineMap, samples: Array, x: Array, room: Array) -> Array:
    """CT points and volume ratios (n, 4) of points x (n, 3) of the state where `room` (n,) says; plain beyond it."""
    out = np.zeros((len(x), 4))
    out[:, 3] = 1.0
    mapped = piece(samples)
    found, left = piece.inverse(x[room], samples, 1e-3)
    gap, near = cKDTree(mapped).query(x[room])
    plain = samples[near] + 1.5 * (x[room] - mapped[near])
    bad = (left > 0.01) | (gap > 14)
    found[bad] = plain[bad]
    out[room, :3] = found
    out[room, 3] = np.clip(piece.determinant(found), 0.1, 3.0)
    return out
