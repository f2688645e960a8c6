"""Inflated and collapsed lung of a thorax on the table: cage, tissue, equilibrium and pose of each state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from phantoms.cage import CageMotion, fit_dome
from phantoms.disease import emphysema_of, fibrosis_of
from phantoms.fields import Lattice, coverage, patches, smooth_noise, smoothstep
from phantoms.imaging import Look, State
from phantoms.lobes import surface_points
from phantoms.patient import Patient
from phantoms.spec import Collapse, Disease, PhantomSpec
from phantoms.tissue import Equilibrium, Pleura, Scene, Tie, Tissue, relax, tissue_points

Array = NDArray[Any]
HINGE_MM = 13.0
"""Around the hilum, tissue of a lung in lobes is tied to the mediastinum this far, so that lobes may swing."""
ROOT_KPA_MM = 300.0
"""Stiffness a point of the root's tie to the mediastinum."""
HELD_LEAST = 0.5
"""Rest volume over that in the CT, at least, of lung that the wall holds open. Under 0.30 tissue resists less the more
it is stretched, and one lobe would empty into another; at 0.5 what is emptier by two deviations is still above that.
"""
SCAR_KPA_MM = 300.0
"""Stiffness a point of the pleura's tie to the wall where the two have grown together."""


def make_states(
    patient: Patient, spec: PhantomSpec, rng: np.random.Generator
) -> tuple[tuple[State, State], Array, list[Equilibrium]]:
    """Inflated and deflated state of the operated lung, gravity (3,) in the CT's frame, and both equilibria.

    Gravity acts from the operated side to the other.
    """
    sign, lung = patient.sign, patient.lung
    collapse = spec.collapse
    inflated_motion = fit_dome(CageMotion(patient.build, sign, 0.0, 16.0, 5.0, 6.0), lung, collapse.inflated)
    deflated_motion = replace(
        inflated_motion,
        operated_dome=inflated_motion.operated_dome + collapse.dome_rise,
        shift=collapse.shift,
        squeeze=4.0,
    )
    gravity = np.array([-sign, 0.15, 0.05]) + rng.normal(0, 0.03, 3)
    gravity /= np.linalg.norm(gravity)
    airless = airless_of(patient, collapse, gravity)
    body = lung_body(patient, collapse, spec.element, rng, spec.disease, airless)
    poses = _poses(patient.scanned_centre, rng)
    states, ends = [], []
    for motion, held, pose in ((inflated_motion, True, poses[0]), (deflated_motion, False, poses[1])):
        cavity, end = body.settle(motion, gravity, held, None if held else collapse.deflated)
        ends.append(end)
        look = Look() if held else _look(cavity, collapse, gravity, airless)
        states.append(State(lung, cavity, motion, end.state_from_ct, held, pose, body.tissue.points, look))
    return (states[0], states[1]), gravity, ends


def airless_of(patient: Patient, collapse: Collapse, gravity: Array) -> Lattice | None:
    """Where the collapsed lung holds no gas, on a lattice in the CT; None where it does everywhere."""
    if collapse.airless <= 0:
        return None
    lung = patient.lung
    down = (lung.points() @ gravity).reshape(lung.values.shape)
    inside = lung.values < 0
    hangs = (down - down[inside].mean()) / down[inside].std()
    # Thin edges, which nothing holds open, lose their gas before the middle does.
    edge = np.exp(-np.maximum(-lung.values, 0) / 12)
    return patches(lung, collapse.airless, 20.0, np.random.default_rng([patient.seed, 21]), 0.7 * hangs + edge)


def _look(cavity: Lattice, collapse: Collapse, gravity: Array, airless: Lattice | None) -> Look:
    if collapse.fluid <= 0:
        return Look(airless, collapse.vessels)
    depth = (cavity.points() @ gravity)[cavity.values.ravel() < 0]
    return Look(airless, collapse.vessels, gravity, float(depth.max() - collapse.fluid))


@dataclass(frozen=True)
class LungBody:
    """The operated lung as a body that settles under loads. tissue, held: free, and where the wall holds it open;
    surface: points (n, 3) mm, areas (n,), lobes (n,); tied: (n,) the tissue that belongs to the hilum; root: factor on
    how firmly it is held; grown: (n,) the surface that has grown to the chest wall."""

    patient: Patient
    tissue: Tissue
    held: Tissue
    surface: tuple[Array, Array, Array]
    tied: Array
    root: float
    grown: Array
    element_mm: float

    def settle(
        self, motion: CageMotion, gravity: Array, held: bool, volume_ratio: float | None = None
    ) -> tuple[Lattice, Equilibrium]:
        """The lung's room after the walls' motion, as a signed distance (mm), and the lung at rest in it."""
        lung, t = self.patient.lung, self.held if held else self.tissue
        cavity = motion.carry(lung)
        skin, _, lobe = (column[self.grown] for column in self.surface)
        ties = [Tie(t.points[self.tied], motion(t.points[self.tied]), self.root * ROOT_KPA_MM, t.lobe[self.tied])]
        if len(skin) > 0:
            ties.append(Tie(skin, motion(skin), SCAR_KPA_MM, lobe))
        pleura = _pleura(self.surface, lung, cavity, held)
        lobes = self.patient.lobes
        return cavity, relax(Scene(t, pleura, ties, lobes, gravity), motion, volume_ratio, self.element_mm)


def lung_body(
    patient: Patient,
    collapse: Collapse,
    element_mm: float,
    rng: np.random.Generator,
    disease: Disease | None = None,
    airless: Lattice | None = None,
) -> LungBody:
    """The operated lung of a patient, pre-stressed to collapse so far and so unevenly; airless: see `airless_of`."""
    lobes = patient.lobes
    points, volume, lobe = _by_lobe([tissue_points(region, element_mm / 2) for region in lobes.regions])
    surface = _by_lobe([surface_points(region, 2) for region in lobes.regions])
    tied = np.linalg.norm(points - patient.hilum, axis=1) < (20.0 if len(lobes.regions) == 1 else HINGE_MM)
    shear, slack = _uneven(patient, points, collapse, rng)
    if disease is not None:
        trapped, scarred = (
            of(patient.lung, disease, patient.seed).sample(points) for of in (emphysema_of, fibrosis_of)
        )
        shear, slack = shear * (1 + 4 * scarred) * (1 - 0.4 * trapped), slack * (1 + 0.7 * trapped)
    held = Tissue(points, volume, shear, _rest(max(collapse.deflated, HELD_LEAST), slack), 165.0, lobe)
    # Lobes trap gas or empty, and tissue loses its last gas, once the wall has let go.
    slack = slack * np.exp(collapse.lobes_apart * _odds(len(lobes.regions), patient.seed))[lobe]
    if airless is not None:
        share = airless.sample(points)
        shear, slack = shear * (1 + 2 * share), slack * (1 - 0.45 * share)
    tissue = replace(held, shear=shear, rest=_rest(collapse.deflated, slack))
    grown = _grown_to_wall(surface[0], patient, collapse.adhesion)
    return LungBody(patient, tissue, held, surface, tied, collapse.root, grown, element_mm)


def _rest(ratio: float, slack: Array) -> Array:
    """Rest length (n,) over length in the CT of tissue that collapses to `ratio` of its volume times `slack` (n,)."""
    return np.asarray(np.cbrt(np.clip(ratio * slack, 0.15, 0.95)))


def _grown_to_wall(points: Array, patient: Patient, radius: float) -> Array:
    """Whether points (n, 3) of the lobes' surfaces have grown to the chest wall: those of the costal pleura within
    `radius` (mm) of its place furthest out and up."""
    outer = _on_wall(points, patient.lung)
    middle = points[np.argmax(np.where(outer, points @ [patient.sign, 0.0, 0.5], -np.inf))]
    return outer & (np.linalg.norm(points - middle, axis=1) < radius)


def _on_wall(points: Array, lung: Lattice) -> Array:
    """Whether points (n, 3) of the lobes' surfaces lie on the surface of the whole lung, not in a fissure."""
    return np.asarray(lung.sample(points) > -1.5)


def _by_lobe(parts: list[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Points, what each stands for, and the lobe of each, from those of every lobe."""
    points, share = (np.concatenate(column) for column in zip(*parts, strict=True))
    return points, share, np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])


def _pleura(surface: tuple[Array, Array, Array], lung: Lattice, cavity: Lattice, held: bool) -> Pleura:
    """What touches the wall: all of the lobes' surfaces where they are free, only their outer sides where held."""
    points, area, lobe = surface
    outer = _on_wall(points, lung) if held and lobe.max() > 0 else np.full(len(points), True)
    return Pleura(points[outer], area[outer], cavity, held, lobe[outer])


def _uneven(patient: Patient, points: Array, collapse: Collapse, rng: np.random.Generator) -> tuple[Array, Array]:
    """Shear modulus (kPa) and factor on the rest volume: patchy tissue, soft fissure, stiff root, airless tissue and
    nodule."""
    patchiness = collapse.patchiness
    lung, hilum = patient.lung, patient.hilum
    shear = 0.65 * collapse.stiffness * np.exp(0.45 * patchiness * lung.like(smooth_noise(lung, 32.0, rng)).at(points))
    slack = np.exp(0.22 * patchiness * lung.like(smooth_noise(lung, 38.0, rng)).at(points))
    shear *= 1 + 5 * collapse.root * np.exp(-((np.linalg.norm(points - hilum, axis=1) / 24) ** 2))
    fissures = patient.lobes.fissures
    shear *= 1 - 0.85 * np.exp(-((fissures.distance(points) / 8) ** 2)) * fissures.grown(points)
    airless = _airless(points, collapse.atelectasis)
    shear *= 1 + 5 * airless
    slack *= 1 - 0.75 * airless
    lesion = coverage(patient.nodule.distance(points), 8.0) * (patient.nodule.seen == "all")
    return shear * (1 + (patient.nodule.stiffening - 1) * lesion), slack + lesion * (1.6 - slack)


def _odds(count: int, seed: int) -> Array:
    """Numbers (count,) of zero mean and unit deviation, drawn from a seed; zero for a single one."""
    z = np.random.default_rng([seed, 4]).standard_normal(count)
    return np.asarray((z - z.mean()) / max(z.std(), 1e-9))


def _airless(points: Array, share: float) -> Array:
    """One (n,) in the `share` of the lung that lies furthest back and down, zero in front, smooth over 12 mm."""
    down = -points @ np.array([0.0, 0.8, 0.6])
    return (
        smoothstep(down, *(np.quantile(down, 1 - share) + np.array([-6.0, 6.0])))
        if share > 0
        else np.zeros(len(points))
    )


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
