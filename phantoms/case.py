"""A whole case from a name and a seed: CT, both cone-beam images, nodule, landmarks, and the truth of the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.cbct import expose, scanner_grid
from phantoms.disease import diseased
from phantoms.fields import coverage
from phantoms.imaging import Picture, State, image_state
from phantoms.measures import measure
from phantoms.nodule import Nodule, nodule_mask, paint_nodule
from phantoms.patient import Patient
from phantoms.ports import draw_ports
from phantoms.projection import Beat, expose_views, scene_grid
from phantoms.recipes import SPECS
from phantoms.size import body_units, scaled, scaled_region, scanner_of_size
from phantoms.spec import PhantomSpec
from phantoms.states import make_states
from phantoms.thorax import Thorax, ct_grid, draw_lung_trees, draw_table, draw_thorax, image_body, operated_lung
from phantoms.tissue import Equilibrium
from phantoms.voxels import Grid, Image, Region

Array = NDArray[Any]
CT_BLUR_MM = 0.7
"""Standard deviation of a diagnostic scanner's point spread."""


@dataclass(frozen=True)
class PhantomCase:
    """A case and its truth. Images in HU; points in RAS mm of their own image's frame.

    gravity_cbct: (3,) unit vector in the frame of the CBCTs; landmarks: (n, 3); dense_truth: (n, 9) in the CT, inflated
    and deflated; patient: the person; inflated, deflated: the states, which give the map at any point, in mm of a
    person of adult size.
    """

    spec: PhantomSpec
    seed: int
    side: str
    ct: Image
    cbct_inflated: Image
    cbct_deflated: Image
    nodule: Region
    nodule_ct: Array
    nodule_inflated: Array
    nodule_deflated: Array
    landmarks_ct: Array
    landmarks_inflated: Array
    landmarks_deflated: Array
    dense_truth: Array
    gravity_cbct: Array
    patient: Patient
    inflated: State
    deflated: State
    masks: dict[str, Region]
    info: dict[str, Any]


@dataclass(frozen=True)
class Shot:
    """What the scanner needs to know beside the scene. gravity: (3,) unit vector in the frame of the CT."""

    spec: PhantomSpec
    gravity: Array
    rng: np.random.Generator


def make_case(spec: PhantomSpec | str, seed: int = 0) -> PhantomCase:
    """The case of a spec, or of a name in `SPECS`; equal seeds give equal cases."""
    if isinstance(spec, str):
        if spec not in SPECS:
            raise ValueError(f"no phantom is called {spec!r}, choose one of {', '.join(SPECS)}")
        spec = SPECS[spec]
    if spec.side not in ("right", "left"):
        raise ValueError(f"side must be 'right' or 'left', got {spec.side!r}")
    if spec.scanner.domain not in ("image", "projection"):
        raise ValueError(f"the scanner's domain must be 'image' or 'projection', got {spec.scanner.domain!r}")
    if spec.lesion.seen not in ("all", "ct and inflated", "ct"):
        raise ValueError(f"a lesion is seen in 'all', 'ct and inflated' or 'ct', got {spec.lesion.seen!r}")
    rng = np.random.default_rng([seed, 11])
    adult = body_units(spec)
    thorax = draw_thorax(spec.side, spec.habitus, adult.lesion, seed, spec.fused)
    ill = diseased(thorax.parenchyma, operated_lung(thorax.shapes, spec.side), spec.disease, seed)
    thorax = replace(thorax, parenchyma=ill)
    patient = thorax.patient
    table = make_states(patient, adult, rng)
    ct, body, ct_lung = _ct(thorax, patient, adult, rng)
    return _resized(finish_case(patient, adult, seed, table, (ct, body, ct_lung), _forks(patient), rng), spec)


def finish_case(
    patient: Patient,
    spec: PhantomSpec,
    seed: int,
    table: tuple[tuple[State, State], Array, list[Equilibrium]],
    scan: tuple[Image, Image, Region],
    places: Array,
    rng: np.random.Generator,
) -> PhantomCase:
    """The case of a patient whose states on the `table` are known. scan: CT, the same without the operated lung and
    noise, and that lung's mask; places: (n, 3) mm in the CT, where landmarks may be."""
    (states, gravity, ends), (ct, body, ct_lung) = table, scan
    view = patient.scanned_centre + spec.view
    grid = scanner_grid(view, spec.cbct_spacing, spec.scanner.length, spec.scanner.fov)
    grids = [_moved_grid(grid, s) for s in states]
    scenes = [scene_grid(g) if spec.scanner.domain == "projection" else g for g in grids]
    pictures = [image_state(patient, body, s, g) for s, g in zip(states, scenes, strict=True)]
    shot = Shot(spec, gravity, rng)
    shots = [_shoot(p, g, patient, s, shot) for p, g, s in zip(pictures, grids, states, strict=True)]
    pictures = [_seen_on(g, p) for g, p in zip(grids, pictures, strict=True)]
    nodule = nodule_mask(patient.nodule, ct.grid)
    nodule_points = [_nodule_centre(patient.nodule, s) for s in states]
    ct_marks = _landmarks(places, states, grids, spec.scanner.fov, rng)
    marks = [s.from_ct(ct_marks) for s in states]
    tissue = states[0].samples[patient.lung.sample(states[0].samples) < -1.0]
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
        patient=patient,
        inflated=states[0],
        deflated=states[1],
        masks=_masks(ct_lung, pictures),
        info=measure(states, ct_marks, dense_ct, ends),
    )


def _shoot(picture: Picture, view: Grid, patient: Patient, state: State, shot: Shot) -> Image:
    """Cone-beam CT of a state, in the domain that the scanner is simulated in. The scanner works in true mm."""
    spec, rng = shot.spec, shot.rng
    size, scanner = spec.size, scanner_of_size(spec.scanner, spec.size)
    if scanner.domain == "image":
        return scaled(expose(scaled(picture.clean, size), scanner, rng), 1 / size)
    if not state.held:
        draw_ports(picture.clean, state, scanner.flaws.ports, -shot.gravity, rng)
    heart, wall = patient.build.heart
    beat = Beat(state.posed(state.motion(heart[None]))[0] * size, float(wall.mean()) * size, scanner.flaws.heart)
    grid = scaled(Image(np.zeros(view.shape, dtype=bool), view.ras_from_ijk), size).grid
    return scaled(expose_views(scaled(picture.clean, size), grid, scanner, rng, beat=beat), 1 / size)


def _seen_on(view: Grid, picture: Picture) -> Picture:
    """The picture with its masks on the voxels of a view."""
    if picture.clean.grid.shape == view.shape:
        return picture
    step = picture.clean.grid.spacing
    index = [
        np.arange(n) * h / s + off
        for n, h, s, off in zip(
            view.shape, view.spacing, step, picture.clean.grid.to_ijk(view.to_ras(np.zeros(3))), strict=True
        )
    ]
    nearest = np.ix_(*(np.rint(i).astype(int) for i in index))
    lung, nodule = (Region(m.inside[nearest], view.ras_from_ijk) for m in (picture.lung, picture.nodule))
    return replace(picture, lung=lung, nodule=nodule)


def _resized(case: PhantomCase, spec: PhantomSpec) -> PhantomCase:
    """A case in units of the person's size (see `body_units`) in mm, with the spec that it was made from."""
    s = spec.size
    if s == 1:
        return case
    regions = {name: scaled_region(m, s) for name, m in case.masks.items()}
    info = {k: (np.array(v) * s).tolist() if k.endswith("_mm") else v for k, v in case.info.items()}
    info["pose"] = [(np.array(pose) * np.array([1.0, 1.0, 1.0, s])).tolist() for pose in case.info["pose"]]
    for pose in info["pose"]:
        pose[3][3] = 1.0
    return replace(
        case,
        spec=spec,
        ct=scaled(case.ct, s),
        cbct_inflated=scaled(case.cbct_inflated, s),
        cbct_deflated=scaled(case.cbct_deflated, s),
        nodule=scaled_region(case.nodule, s),
        nodule_ct=case.nodule_ct * s,
        nodule_inflated=case.nodule_inflated * s,
        nodule_deflated=case.nodule_deflated * s,
        landmarks_ct=case.landmarks_ct * s,
        landmarks_inflated=case.landmarks_inflated * s,
        landmarks_deflated=case.landmarks_deflated * s,
        dense_truth=case.dense_truth * s,
        masks=regions,
        info=info,
    )


def _moved_grid(grid: Grid, state: State) -> Grid:
    centre = grid.to_ras((np.array(grid.shape) - 1) / 2)
    affine = grid.ras_from_ijk.copy()
    affine[:3, 3] += np.round(state.posed(centre[None])[0]) - centre
    return Grid(grid.shape, affine)


def _ct(thorax: Thorax, patient: Patient, spec: PhantomSpec, rng: np.random.Generator) -> tuple[Image, Image, Region]:
    """The CT, the same without noise and operated lung, and the mask of that lung."""
    grid = ct_grid(thorax, spec.ct_spacing)
    width = float(grid.spacing.mean())
    other = "left" if spec.side == "right" else "right"
    body = image_body(thorax, grid, (other,))
    distance = thorax.shapes.lung(spec.side).on(grid)
    tissue = thorax.parenchyma.on(grid)
    inside = distance < width
    tissue[inside] += patient.lobes.fissures.density(grid.points()[inside])
    hu = body + coverage(distance, width) * (tissue - body)
    draw_lung_trees(hu, thorax.trees[thorax.index(spec.side)], grid, width)
    paint_nodule(hu, grid, patient.nodule, width)
    draw_table(hu, grid, thorax.shapes.body)
    hu = ndimage.gaussian_filter(hu, CT_BLUR_MM / grid.spacing)
    noise = ndimage.gaussian_filter(rng.standard_normal(grid.shape, dtype=np.float32), 0.5)
    hu += noise * (14.0 / noise.std())
    affine = grid.ras_from_ijk
    return Image(np.clip(hu, -1024, 3071), affine), Image(body, affine), Region(distance < 0, affine)


def _nodule_centre(nodule: Nodule, state: State) -> Array:
    """Centre of mass of the nodule in the state, RAS mm of its image: mapped points weighted by their volume."""
    ball = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 17)] * 3), axis=-1).reshape(-1, 3) * nodule.radius
    ball += nodule.centre
    ball = ball[nodule.distance(ball) < 0]
    weight = state.lung_map.determinant(ball)
    return np.asarray(weight @ state.from_ct(ball) / weight.sum())


def _forks(patient: Patient) -> Array:
    """Forks (n, 3) of vessels and airways inside the lung in the CT, RAS mm, of branches wide enough to be seen."""
    sets = []
    for tree in () if patient.trees is None else (patient.trees.airway, patient.trees.artery, patient.trees.vein):
        forks = tree.forks()
        sets.append(tree.nodes[forks[tree.radius[forks] > 1.15]])
    points = np.concatenate(sets)
    return np.asarray(points[patient.lung.at(points) < -4.0])


def _landmarks(
    points: Array, states: tuple[State, State], grids: list[Grid], fov: float, rng: np.random.Generator
) -> Array:
    """Those of `points` (n, 3) in the CT, RAS mm, that both cone-beam images show, spread far apart."""
    for state, grid in zip(states, grids, strict=True):
        ijk = grid.to_ijk(state.from_ct(points))
        off = (ijk - (np.array(grid.shape) - 1) / 2) * grid.spacing
        half = grid.shape[2] * grid.spacing[2] / 2
        points = points[(np.hypot(off[:, 0], off[:, 1]) < fov / 2 - 8) & (np.abs(off[:, 2]) < half - 14)]
    chosen = [int(rng.integers(len(points)))]
    reach = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(48, len(points)):
        chosen.append(int(reach.argmax()))
        reach = np.minimum(reach, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _masks(ct_lung: Region, pictures: list[Picture]) -> dict[str, Region]:
    return {
        "lung_ct": ct_lung,
        "lung_inflated": pictures[0].lung,
        "lung_deflated": pictures[1].lung,
        "nodule_inflated": pictures[0].nodule,
        "nodule_deflated": pictures[1].nodule,
    }
