"""The model of the collapse, in rungs of rising freedom, each kept only if places held back from it say so.

1. The poroelastic lung, fitted to the visible surface. 2. Smooth regional stretches and the hilum's place as further
parameters, fitted to surface and to places found again inside the lung. 3. An elastic correction that follows both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from poro.correct import correct, pull_of
from poro.fit import Fit, FitSettings, fit
from poro.mesh import TetMesh, interpolate, locate
from poro.model import PoroSystem, assemble
from poro.modes import hilum_modes, shape_modes
from poro.observations import Target
from poro.tissue import Tissue
from registration.matching import MatchSettings, Pairs, match_keypoints
from registration.resample import resample, resample_mask
from registration.volume import Array, Mask
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.maps import MeshMap, covered, sampled
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

PRIOR_SPACING_MM = 3.0
BLOCK_MM = 40.0
"""Keypoints are held back by blocks this wide: neighbours tell nearly the same."""
LEAST_PAIRS = 40
CORRECTION_STRAINS = (0.05, 0.025, 0.0125)
LEAST_DET = 0.05
GAIN = 0.95
"""A rung has to bring the misfit below this share of the one before."""


@dataclass(frozen=True)
class Rung:
    """One step of freedom. before_mm, after_mm: median misfit at places that the step has not seen, without and with
    it; kept: whether it was taken.
    """

    name: str
    before_mm: float
    after_mm: float
    kept: bool


@dataclass(frozen=True)
class Model:
    """The collapse by mechanics. displacement: (n, 3) mm at the nodes of system.mesh, correction included.

    pairs: places found again, in the deflated CBCT's frame: `first` before the collapse (placed by the spine), `second`
    after it; rungs: what was tried beyond the plain fit.
    """

    system: PoroSystem
    fit: Fit
    displacement: Array
    pairs: Pairs
    rungs: tuple[Rung, ...]

    @property
    def held_back_mm(self) -> float | None:
        """Median misfit at places held back from the last rung that was kept; None without keypoints."""
        kept = [rung.after_mm if rung.kept else rung.before_mm for rung in self.rungs]
        return kept[-1] if kept else None


Step = Callable[[Model, Target, Fit], Model]
"""From a model and what to follow to a freer model; the fit is where to start from."""


def climb(gravity: Array, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages) -> Model:
    """Fit the collapse to what was observed, rung by rung."""
    tissue, mesh = Tissue(), observed.model_mesh
    with stages.stage("model set-up"):
        system = assemble(mesh, tissue, gravity, observed.hilum_nodes, observed.motion.displacement)
    surface = surface_target(observed.surface)
    with stages.stage("fit"):
        plain = fit(system, surface, fit_settings(settings))
    model = Model(system, plain, plain.state.u, NO_PAIRS, ())
    if not settings.keypoints.on:
        stages.skip("keypoints", "switched off in the settings")
        return model
    with stages.stage("keypoints"):
        pairs = inner_pairs(prepared, observed, model.displacement, settings)
    if len(pairs) < LEAST_PAIRS:
        stages.skip("regional fit", f"only {len(pairs)} places inside the lung were found again")
        return replace(model, pairs=pairs)
    hidden = held_back(pairs.second)
    if not hidden.any() or hidden.all():
        stages.skip("regional fit", "the places found again lie too close together to hold some back")
        return replace(model, pairs=pairs)
    steps: dict[str, Step] = {}
    if settings.model.regional:
        steps["regional fit"] = _regional(gravity, settings)
    if settings.model.correct:
        steps["elastic correction"] = _corrected
    return _climbed(replace(model, pairs=pairs), surface, hidden, steps, stages)


def _climbed(model: Model, surface: Target, hidden: Array, steps: dict[str, Step], stages: Stages) -> Model:
    """Every step is first tried without the hidden pairs; those that predict them better are taken with all pairs."""
    blind, rungs = model, []
    for name, step in steps.items():
        with stages.stage(name):
            mesh, unseen = model.system.mesh, model.pairs.only(hidden)
            trial = step(blind, _with(surface, model.pairs.only(~hidden)), blind.fit)
            before, after = (misfit(mesh, one.displacement, unseen) for one in (blind, trial))
            rungs.append(Rung(name, before, after, after < GAIN * before))
            if rungs[-1].kept:
                blind = trial
                model = step(model, _with(surface, model.pairs), trial.fit)
    return replace(model, rungs=tuple(rungs))


NO_PAIRS = Pairs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def inner_pairs(prepared: Prepared, observed: Observed, displacement: Array, settings: Settings) -> Pairs:
    """Places inside the lung that both CBCTs show, looked for about where a displacement (n, 3) mm puts them.

    `first` is where they lie before the collapse, placed by the spine.
    """
    rest = observed.model_mesh
    moved = TetMesh(rest.points + displacement, rest.tets)
    rigid = observed.def_from_inf_rigid
    grid = prepared.deflated.volume.grid
    inf_from_def = MeshMap(moved, rigid.inverse()(rest.points), rigid.inverse())
    prior = sampled(inf_from_def, grid.with_spacing(PRIOR_SPACING_MM))
    warped = resample(prepared.inflated.volume, grid, prior)
    both = resample_mask(prepared.inflated.field.usable, grid, prior).inside & prepared.deflated.field.usable.inside
    lung = resample_mask(observed.found.lung, grid).inside
    expected = covered(moved, grid).inside & both
    match = MatchSettings(voxel_mm=settings.keypoints.voxel_mm, reach_mm=settings.keypoints.reach_mm)
    pairs = match_keypoints(
        warped,
        prepared.deflated.volume,
        Mask(lung & both, grid.ras_from_ijk),
        match,
        first_region=Mask(expected, grid.ras_from_ijk),
    )
    return Pairs(rigid(inf_from_def(pairs.first)), pairs.second, pairs.ncc)


def held_back(points: Array) -> Array:
    """A quarter of points (n, 3), by blocks, the same ones in every run, (n,) bool."""
    block = np.floor(points / BLOCK_MM).astype(int)
    return np.asarray((block @ np.array([1, 2, 3])) % 4 == 0)


def surface_target(surface: SurfacePoints) -> Target:
    """What the model is compared with; a one-piece lung has no fissures, so those points are left out."""
    outer = surface.only(Border.AIR, Border.CONTACT, Border.DENSE)
    return Target(outer.points, outer.normals, outer.confidence)


def fit_settings(settings: Settings, modes: int = 0) -> FitSettings:
    """The fit's own settings, from those of a run."""
    plain = settings.model.cost == "plain"
    free = (True, True, settings.model.diaphragm, *modes * (True,))
    sigma = settings.keypoints.sigma_mm
    return FitSettings(plain=plain, free=free, max_steps=settings.model.max_steps, keypoint_sigma_mm=sigma)


def _with(target: Target, pairs: Pairs) -> Target:
    return replace(target, inflated=pairs.first, deflated=pairs.second, keypoint_weights=np.ones(len(pairs)))


def misfit(mesh: TetMesh, displacement: Array, pairs: Pairs) -> float:
    """Median distance in mm between where displacements (n, 3) of a mesh put places and where they were found."""
    moved = pairs.first + interpolate(locate(mesh, pairs.first), displacement)
    return float(np.median(np.linalg.norm(moved - pairs.second, axis=1)))


def _regional(gravity: Array, settings: Settings) -> Step:
    """Smooth stretches of the resting shape, and the hilum's place, as further parameters of the fit."""

    def step(model: Model, target: Target, start: Fit) -> Model:
        mesh, tissue = model.system.mesh, model.system.tissue
        modes = shape_modes(mesh, tissue, gravity, degree=0)
        modes += hilum_modes(mesh, model.system.hilum) if settings.model.hilum else ()
        system = replace(model.system, modes=modes)
        theta = start.theta
        chosen = replace(
            fit_settings(settings, len(modes)), starts=((theta.kappa_b, theta.phi, theta.d_diaph_mm, *theta.modes),)
        )
        found = fit(system, target, chosen)
        return replace(model, system=system, fit=found, displacement=found.state.u)

    return step


def _corrected(model: Model, target: Target, _start: Fit) -> Model:
    """An elastic field on top, stiffer where it would turn elements inside out; none where that does not help."""
    mesh, tissue = model.system.mesh, model.system.tissue
    pull = pull_of(target, mesh, model.displacement)
    for strain in CORRECTION_STRAINS:
        found = correct(mesh, model.displacement, tissue, pull, strain)
        if (found.det_f > LEAST_DET).all() or found.det_f.min() >= model.fit.state.det_f.min():
            return replace(model, displacement=model.displacement + found.u)
    return model
