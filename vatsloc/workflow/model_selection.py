"""The model of the collapse, in refinements of rising freedom, each kept only if places held back from it say so.

1. The poroelastic lung, fitted to the visible surface. 2. Smooth regional stretches and the hilum's place as further
parameters, fitted to surface and to places found again inside the lung. 3. An elastic correction that follows both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from poro.collapse import (
    LinearRange,
    PoroStatus,
    PoroSystem,
    assemble,
    hilum_modes,
    keep_in_range,
    uniform_strain_modes,
)
from poro.collapse import StrainMeasure as Strain
from poro.collapse.choice import StrainChoice
from poro.fem import Tissue, neo_hookean
from poro.fit import Fit, FitSettings, FitStatus, Target, constraints_to, elastic_correction, fit_collapse
from poro.mesh import TetMesh, interpolate, locate
from registration.correspondences import Correspondences
from registration.volume import Array
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow.choices import Choice
from vatsloc.workflow.ensemble import perturbation_ensemble
from vatsloc.workflow.keypoints import find_correspondences
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

BLOCK_MM = 40.0
"""Keypoints are held back by blocks this wide: neighbours tell nearly the same."""
LEAST_CORRESPONDENCES = 40
CORRECTION_STRAINS = (0.05, 0.025, 0.0125)
MOST_INVERTED = 0.001
STRAIN = "finite strain"
"""A part that the scene has a say in."""
GAIN = 0.95
"""A refinement has to bring the misfit below this share of the one before."""


@dataclass(frozen=True)
class Refinement:
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

    pairs: keypoints matched in both CBCTs, in the deflated one's frame: `moving` before the collapse (placed by the
    spine), `fixed` after it; refinements: what was tried beyond the plain fit; solid: which strain measure the plain fit
    ended with, and why; others: (k, n, 3) mm, how far from `displacement` other answers lie: without any refinement those of
    `perturbation_ensemble`, with one that of the model that has not seen all places.
    """

    system: PoroSystem
    fit: Fit
    displacement: Array
    pairs: Correspondences
    refinements: tuple[Refinement, ...]
    solid: StrainChoice
    others: Array

    @property
    def held_out_mm(self) -> float | None:
        """Median misfit at places held back from the last refinement that was kept, or from the plain fit; None untried."""
        known = [refinement.before_mm for refinement in self.refinements[:1]] + [
            refinement.after_mm for refinement in self.refinements if refinement.kept
        ]
        return known[-1] if known else None


Step = Callable[[Model, Target, Fit], Model]
"""From a model and what to follow to a freer model; the fit is where to start from."""


def select_model(gravity: Array, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages) -> Model:
    """Fit the collapse to what was observed, refinement by refinement."""
    tissue, mesh = Tissue(), observed.model_mesh
    with stages.stage("model set-up"):
        system = assemble(mesh, tissue, gravity, observed.hilum_nodes, observed.motion.displacement)
    surface = surface_target(observed.surface)
    with stages.stage("fit"):
        plain = fit_collapse(system, surface, fit_settings(settings))
        within = LinearRange(share=settings.leave_out.strained_share)
        solid = keep_in_range(system, plain.state, neo_hookean(tissue), within)
    is_finite = solid.strain is Strain.FINITE
    stages.choose(Choice(STRAIN, is_finite, solid.why, solid.share, within.share))
    start = Model(system, replace(plain, state=solid.state), solid.state.u, NO_CORRESPONDENCES, (), solid, NO_ENSEMBLE)
    model, training_only = _rungs(start, surface, prepared, observed, settings, stages)
    if any(refinement.kept for refinement in model.refinements):
        return replace(model, others=(training_only.displacement - model.displacement)[None])
    with stages.stage("other answers"):
        return replace(model, others=perturbation_ensemble(system, surface, plain, fit_settings(settings)))


def _rungs(
    model: Model, surface: Target, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages
) -> tuple[Model, Model]:
    """The model with what was kept beyond the plain fit, and the one that has not seen the places held back."""
    if not settings.keypoints.on:
        stages.skip("keypoints", "switched off in the settings")
        return model, model
    with stages.stage("keypoints"):
        model = replace(model, pairs=find_correspondences(prepared, observed, model.displacement, settings.keypoints))
    training_only, why = model, _too_few(model.pairs)
    if why:
        stages.skip("regional fit", why)
        return model, model
    if settings.model.regional:
        with stages.stage("regional fit"):
            steps = {"regional fit": _regional(settings)}
            model, training_only = best_of(steps, model, training_only, surface)
    if settings.model.correct:
        with stages.stage("elastic correction"):
            data = fit_settings(settings)
            steps = {f"elastic correction, strain {strain:g}": corrected(strain, data) for strain in CORRECTION_STRAINS}
            model, training_only = best_of(steps, model, training_only, surface)
    return model, training_only


def best_of(steps: dict[str, Step], model: Model, training_only: Model, surface: Target) -> tuple[Model, Model]:
    """Steps are first tried on the model that has not seen the hidden pairs. The one that predicts them best, if better
    than without, is taken again with all pairs for the model proper; where that fails, the next best is.
    """
    mesh, hidden = model.system.mesh, held_out(model.pairs.fixed)
    unseen, shown = model.pairs.only(hidden), _with(surface, model.pairs.only(~hidden))
    trials = {name: step(training_only, shown, training_only.fit) for name, step in steps.items()}
    before = misfit(mesh, training_only.displacement, unseen)
    after = {name: misfit(mesh, trial.displacement, unseen) for name, trial in trials.items() if _settled(trial)}
    best = None
    for name in sorted((name for name, mm in after.items() if mm < GAIN * before), key=lambda name: after[name]):
        found = steps[name](model, _with(surface, model.pairs), trials[name].fit)
        if found is not model and _settled(found):
            best, model, training_only = name, found, trials[name]
            break
    refinements = (*model.refinements, *(Refinement(name, before, mm, name == best) for name, mm in after.items()))
    return replace(model, refinements=refinements), training_only


def _settled(model: Model) -> bool:
    return model.fit.status is not FitStatus.CONTACT and model.fit.state.status is not PoroStatus.NOT_CONVERGED


def _too_few(pairs: Correspondences) -> str | None:
    """Why pairs cannot judge a refinement; None when they can."""
    hidden = held_out(pairs.fixed)
    if len(pairs) < LEAST_CORRESPONDENCES:
        return f"only {len(pairs)} places inside the lung were found again"
    if min(hidden.sum(), (~hidden).sum()) < LEAST_CORRESPONDENCES // 4:
        return "the places found again lie too close together to hold some back"
    return None


NO_CORRESPONDENCES = Correspondences.none()
NO_ENSEMBLE = np.zeros((0, 0, 3))


def held_out(points: Array) -> Array:
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
    sigma, steps = settings.keypoints.sigma_mm, settings.model.max_steps
    decades = np.inf if plain else FitSettings.kappa_decades
    return FitSettings(plain=plain, free=free, max_steps=steps, keypoint_sigma_mm=sigma, kappa_decades=decades)


def _with(target: Target, pairs: Correspondences) -> Target:
    return replace(target, inflated=pairs.moving, deflated=pairs.fixed, keypoint_weights=pairs.weights)


def misfit(mesh: TetMesh, displacement: Array, pairs: Correspondences) -> float:
    """Median distance in mm between where displacements (n, 3) of a mesh put places and where they were found."""
    moved = pairs.moving + interpolate(locate(mesh, pairs.moving), displacement)
    return float(np.median(np.linalg.norm(moved - pairs.fixed, axis=1)))


def _regional(settings: Settings) -> Step:
    """Smooth stretches of the resting shape, and the hilum's place, as further parameters of the fit."""

    def step(model: Model, target: Target, start: Fit) -> Model:
        mesh, tissue = model.system.mesh, model.system.tissue
        modes = uniform_strain_modes(mesh, tissue)
        modes += hilum_modes(mesh, model.system.hilum) if settings.model.hilum else ()
        system = replace(model.system, modes=modes)
        theta = start.theta
        chosen = replace(
            fit_settings(settings, len(modes)), starts=((theta.kappa_b, theta.phi, theta.d_diaph_mm, *theta.modes),)
        )
        found = fit_collapse(system, target, chosen)
        return replace(model, system=system, fit=found, displacement=found.state.u)

    return step


def corrected(strain: float, settings: FitSettings) -> Step:
    """An elastic field on top; the model itself where that would turn more elements inside out."""

    def step(model: Model, target: Target, _start: Fit) -> Model:
        mesh = model.system.mesh
        wanted = constraints_to(target, mesh, model.displacement, settings)
        found = elastic_correction(mesh, model.displacement, model.system.tissue, wanted, strain)
        inverted, before = ((det <= 0).mean() for det in (found.det_f, model.fit.state.det_f))
        if inverted > max(before, MOST_INVERTED):
            return model
        return replace(model, displacement=model.displacement + found.u)

    return step
