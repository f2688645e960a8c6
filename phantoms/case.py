"""A whole case from a name and a seed: CT, both cone-beam images, nodule, landmarks, and the truth of the motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from phantoms.cage import CageMotion, fit_dome
from phantoms.cbct import Scanner, expose, scanner_grid
from phantoms.fields import Lattice, coverage, smooth_noise
from phantoms.imaging import Picture, State, image_state, nodule_mask
from phantoms.thorax import NODULE_HU, Thorax, ct_grid, draw_lung_trees, draw_thorax, image_body
from phantoms.tissue import Equilibrium, Hilum, Pleura, Tissue, pleura_points, relax, tissue_points
from registration.volume import Grid, Mask, Volume

Array = NDArray[Any]


@dataclass(frozen=True)
class PhantomSpec:
    """What to make. side: operated; ct_spacing, cbct_spacing: mm; inflated, deflated: lung volume over that in the CT;
    dome_rise: mm the diaphragm rises further when the lung collapses; element: mm between nodes of the
    lung's map; patchiness: factor on how uneven the tissue is; nodule_depth, nodule_radius: mm."""

    name: str
    side: str
    ct_spacing: tuple[float, float, float] = (1.2, 1.2, 1.5)
    cbct_spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)
    cbct_length: float = 170.0
    inflated: float = 0.87
    deflated: float = 0.52
    dome_rise: float = 8.0
    element: float = 15.0
    patchiness: float = 1.0
    nodule_depth: float = 15.0
    nodule_radius: float = 8.0
    scanner: Scanner = field(default_factory=Scanner)


_SMALL = PhantomSpec("small", "right", (1.5, 1.5, 2.0), (1.5, 1.5, 1.5), element=18.0)
SPECS = {
    s.name: s
    for s in (
        replace(_SMALL, name="demo", inflated=0.89, deflated=0.55, patchiness=0.6),
        replace(_SMALL, name="small-right"),
        replace(_SMALL, name="small-left", side="left"),
        PhantomSpec("right", "right"),
        PhantomSpec("left", "left", inflated=0.83, nodule_depth=25.0),
        PhantomSpec("small-collapse", "right", deflated=0.64, dome_rise=0.0),
        PhantomSpec("near-total-collapse", "left", deflated=0.42, dome_rise=12.0),
        PhantomSpec("high-diaphragm", "right", dome_rise=20.0, nodule_depth=10.0),
        PhantomSpec("poor-dose", "left", scanner=Scanner(noise=60.0, blur=0.9), nodule_radius=6.0),
    )
}


@dataclass(frozen=True)
class PhantomCase:
    """A case and its truth. Images in HU; points in RAS mm of their own image's frame.

    gravity_cbct: (3,) unit vector in the frame of the CBCTs; landmarks: (n, 3); dense_truth: (n, 9) in the CT, inflated
    and deflated; inflated, deflated: the states, which give the map at any point.
    """

    spec: PhantomSpec
    seed: int
    side: str
    ct: Volume
    cbct_inflated: Volume
    cbct_deflated: Volume
    nodule: Mask
    nodule_ct: Array
    nodule_inflated: Array
    nodule_deflated: Array
    landmarks_ct: Array
    landmarks_inflated: Array
    landmarks_deflated: Array
    dense_truth: Array
    gravity_cbct: Array
    inflated: State
    deflated: State
    masks: dict[str, Mask]
    info: dict[str, Any]


def make_case(spec: PhantomSpec | str, seed: int = 0) -> PhantomCase:
    """The case of a spec, or of a name in `SPECS`; equal seeds give equal cases."""
    if isinstance(spec, str):
        if spec not in SPECS:
            raise ValueError(f"no phantom is called {spec!r}, choose one of {', '.join(SPECS)}")
        spec = SPECS[spec]
    if spec.side not in ("right", "left"):
        raise ValueError(f"side must be 'right' or 'left', got {spec.side!r}")
    rng = np.random.default_rng([seed, 11])
    thorax = draw_thorax(spec.side, spec.nodule_depth, spec.nodule_radius, seed)
    lung = thorax.shapes.lung(spec.side)
    lung = lung.crop(lung.values < 0, 24.0)
    states, gravity, ends = _states(thorax, lung, spec, rng)
    ct, body, ct_lung = _ct(thorax, lung, spec, rng)
    grid = scanner_grid(_centre(thorax), spec.cbct_spacing, spec.cbct_length, spec.scanner.fov)
    grids = [_moved_grid(grid, s) for s in states]
    pictures = [image_state(thorax, body, s, g) for s, g in zip(states, grids, strict=True)]
    shots = [expose(p.clean, spec.scanner, rng) for p in pictures]
    nodule = nodule_mask(thorax.nodule, ct.grid)
    nodule_points = [_nodule_centre(thorax, s) for s in states]
    ct_marks = _landmarks(thorax, lung, states, grids, rng)
    marks = [s.from_ct(ct_marks) for s in states]
    tissue = states[0].samples[lung.sample(states[0].samples) < -1.0]
    dense_ct = tissue[rng.permutation(len(tissue))[:2000]]
    dense = np.concatenate([dense_ct, *(s.from_ct(dense_ct) for s in states)], axis=1)
    centre = nodule.grid.to_ras(np.argwhere(nodule.inside).mean(axis=0))
    return PhantomCase(
        spec=spec,
        seed=seed,
        side=spec.side,
        ct=ct,
        cbct_inflated=shots[0],
        cbct_deflated=shots[1],
        nodule=nodule,
        nodule_ct=centre,
        nodule_inflated=nodule_points[0],
        nodule_deflated=nodule_points[1],
        landmarks_ct=ct_marks,
        landmarks_inflated=marks[0],
        landmarks_deflated=marks[1],
        dense_truth=dense,
        gravity_cbct=states[1].pose[:3, :3] @ gravity,
        inflated=states[0],
        deflated=states[1],
        masks=_masks(ct_lung, pictures),
        info=_info(states, ct_marks, dense_ct, ends, nodule_points),
    )


def _states(
    thorax: Thorax, lung: Lattice, spec: PhantomSpec, rng: np.random.Generator
) -> tuple[tuple[State, State], Array, list[Equilibrium]]:
    sign = 1 if spec.side == "right" else -1
    inflated_motion = fit_dome(CageMotion(thorax.build, sign, 0.0, 16.0, 5.0, 6.0), lung, spec.inflated)
    deflated_motion = replace(
        inflated_motion, operated_dome=inflated_motion.operated_dome + spec.dome_rise, shift=11.0, squeeze=4.0
    )
    gravity = np.array([-sign, 0.15, 0.05]) + rng.normal(0, 0.03, 3)
    gravity /= np.linalg.norm(gravity)
    points, volume = tissue_points(lung, spec.element / 2)
    surface, area = pleura_points(lung, 2)
    hilum = thorax.hila[thorax.index(spec.side)]
    tied = points[np.linalg.norm(points - hilum, axis=1) < 20]
    shear, slack = _uneven(thorax, lung, points, spec.patchiness, rng)
    rest = np.cbrt(np.clip(spec.deflated * slack, 0.15, 0.95))
    poses = _poses(_centre(thorax), rng)
    states, ends = [], []
    for motion, held, pose in ((inflated_motion, True, poses[0]), (deflated_motion, False, poses[1])):
        cavity = motion.carry(lung)
        end = relax(
            Tissue(points, volume, shear, rest, 165.0),
            Pleura(surface, area, cavity, held),
            Hilum(tied, motion(tied), 300.0),
            gravity,
            motion,
            None if held else spec.deflated,
            spec.element,
        )
        ends.append(end)
        states.append(State(lung, cavity, motion, end.state_from_ct, held, pose, points))
    return (states[0], states[1]), gravity, ends


def _uneven(
    thorax: Thorax, lung: Lattice, points: Array, patchiness: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Shear modulus (kPa) and factor on the rest volume at points: patchy tissue, a stiff root, a stiff nodule."""
    hilum = thorax.hila[thorax.index(thorax.side)]
    shear = 0.65 * np.exp(0.45 * patchiness * lung.like(smooth_noise(lung, 32.0, rng)).at(points))
    slack = np.exp(0.22 * patchiness * lung.like(smooth_noise(lung, 38.0, rng)).at(points))
    shear *= 1 + 5 * np.exp(-((np.linalg.norm(points - hilum, axis=1) / 24) ** 2))
    lesion = coverage(thorax.nodule.distance(points), 8.0)
    return shear * (1 + 10 * lesion), slack + lesion * (1.6 - slack)


def _poses(centre: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frames of the two cone-beam images from the CT's: a turn and a shift, a little more of both for the second."""
    first = _about(centre, rng, rng.uniform(8, 18), rng.uniform(30, 50))
    second = _about(centre, rng, rng.uniform(1, 4), rng.uniform(5, 15)) @ first
    return first, second


def _about(centre: Array, rng: np.random.Generator, degrees: float, shift_mm: float) -> Array:
    axis, way = rng.standard_normal((2, 3))
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = centre + shift_mm * way / np.linalg.norm(way) - turn @ centre
    return pose


def _centre(thorax: Thorax) -> Array:
    """Middle of the scanner's field of view in the frame of the CT."""
    sign = 1 if thorax.side == "right" else -1
    return np.array([sign * 50.0, -8.0, -42.0])


def _moved_grid(grid: Grid, state: State) -> Grid:
    centre = grid.to_ras((np.array(grid.shape) - 1) / 2)
    affine = grid.ras_from_ijk.copy()
    affine[:3, 3] += np.round(state.posed(centre[None])[0]) - centre
    return Grid(grid.shape, affine)


def _ct(thorax: Thorax, lung: Lattice, spec: PhantomSpec, rng: np.random.Generator) -> tuple[Volume, Volume, Mask]:
    """The CT, the same without noise and operated lung, and the mask of that lung."""
    grid = ct_grid(thorax, spec.ct_spacing)
    width = float(grid.spacing.mean())
    other = "left" if spec.side == "right" else "right"
    body = image_body(thorax, grid, (other,))
    distance = thorax.shapes.lung(spec.side).on(grid)
    hu = body + coverage(distance, width) * (thorax.parenchyma.on(grid) - body)
    draw_lung_trees(hu, thorax.trees[thorax.index(spec.side)], grid, width)
    _paint_nodule(hu, grid, thorax, width)
    noise = ndimage.gaussian_filter(rng.standard_normal(grid.shape, dtype=np.float32), 0.5)
    hu += noise * (14.0 / noise.std())
    affine = grid.ras_from_ijk
    return Volume(np.clip(hu, -1024, 3071), affine), Volume(body, affine), Mask(distance < 0, affine)


def _paint_nodule(hu: Array, grid: Grid, thorax: Thorax, width: float) -> None:
    reach = thorax.nodule.radius + 4
    corners = grid.to_ijk(thorax.nodule.centre + np.array([[-reach] * 3, [reach] * 3]))
    lo = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
    sub = grid.box(lo, corners.max(axis=0) + 1)
    view = hu[tuple(slice(a, a + n) for a, n in zip(lo, sub.shape, strict=True))]
    view += coverage(thorax.nodule.distance(sub.points()), width) * (NODULE_HU - view)


def _nodule_centre(thorax: Thorax, state: State) -> Array:
    """Centre of mass of the nodule in the state, RAS mm of its image: mapped points weighted by their volume."""
    n = thorax.nodule
    ball = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 17)] * 3), axis=-1).reshape(-1, 3) * n.radius + n.centre
    ball = ball[n.distance(ball) < 0]
    weight = state.lung_map.determinant(ball)
    return np.asarray(weight @ state.from_ct(ball) / weight.sum())


def _landmarks(
    thorax: Thorax, lung: Lattice, states: tuple[State, State], grids: list[Grid], rng: np.random.Generator
) -> Array:
    """Forks of vessels and airways in the CT, RAS mm, that both cone-beam images show, spread far apart."""
    trees = thorax.trees[thorax.index(thorax.side)]
    sets = []
    for tree in (trees.airway, trees.artery, trees.vein):
        forks = tree.forks()
        sets.append(tree.nodes[forks[tree.radius[forks] > 1.15]])
    points = np.concatenate(sets)
    points = points[lung.at(points) < -4.0]
    for state, grid in zip(states, grids, strict=True):
        ijk = grid.to_ijk(state.from_ct(points))
        off = (ijk - (np.array(grid.shape) - 1) / 2) * grid.spacing
        half = grid.shape[2] * grid.spacing[2] / 2
        points = points[(np.hypot(off[:, 0], off[:, 1]) < 112) & (np.abs(off[:, 2]) < half - 14)]
    chosen = [int(rng.integers(len(points)))]
    reach = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(48, len(points)):
        chosen.append(int(reach.argmax()))
        reach = np.minimum(reach, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _masks(ct_lung: Mask, pictures: list[Picture]) -> dict[str, Mask]:
    return {
        "lung_ct": ct_lung,
        "lung_inflated": pictures[0].lung,
        "lung_deflated": pictures[1].lung,
        "nodule_inflated": pictures[0].nodule,
        "nodule_deflated": pictures[1].nodule,
    }


def _info(
    states: tuple[State, State], marks: Array, dense: Array, ends: list[Equilibrium], nodules: list[Array]
) -> dict[str, Any]:
    inflated, deflated = (s.lung_map for s in states)
    pose = np.linalg.norm(inflated(marks) - marks, axis=1)
    collapse = np.linalg.norm(deflated(marks) - inflated(marks), axis=1)
    total = np.linalg.norm(deflated(marks) - marks, axis=1)
    return {
        "n_landmarks": len(marks),
        "pose_mm": [float(pose.mean()), float(pose.max())],
        "pneumothorax_mm": [float(collapse.mean()), float(collapse.max())],
        "total_mm": [float(total.mean()), float(total.max())],
        "volume_ratio": [float(m.determinant(dense).mean()) for m in (inflated, deflated)],
        "smallest_determinant": [float(m.determinant(states[0].samples).min()) for m in (inflated, deflated)],
        "dome_mm": [s.motion.operated_dome for s in states],
        "pose": [s.pose.tolist() for s in states],
        "equilibrium": [e.status.name for e in ends],
        "steps": [len(e.history) for e in ends],
    }
