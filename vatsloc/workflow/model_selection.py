"""The model of the collapse, selected by hold-out: a refinement is kept only if it predicts held-out keypoints better.

1. The poroelastic lung, fitted to the visible surface. 2. Uniform strains of regions and the hilum's position as
further parameters, fitted to the surface and to keypoints inside the lung. 3. An elastic correction that follows both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from poro.collapse import (
    LinearRange,
    PoroStatus,
    PoroSystem,
    hilum_modes,
    keep_in_range,
    still_lung,
    uniform_strain_modes,
)
from poro.collapse import StrainMeasure as Strain
from poro.collapse.choice import StrainChoice
from poro.fem import Tissue, neo_hookean
from poro.fit import Fit, FitSettings, FitStatus, Target, constraints_to, fit_collapse
from poro.fit.elastic_correction import ElasticCorrection, loosened
from poro.mesh import TetMesh, interpolate, locate
from registration.correspondences import Correspondences
from registration.kernels.threads import ahead
from registration.volume import Array
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.workflow.choices import Choice
from vatsloc.workflow.ensemble import perturbation_ensemble
from vatsloc.workflow.hold_out import held_out, too_few
from vatsloc.workflow.keypoints import find_correspondences
from vatsloc.workflow.observe import SET_UP, Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.refinement import unfolded
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

CORRECTION_STRAINS = (0.05, 0.025, 0.0125)
STIFFEST = 0.0125 / 16
"""The strain that their series begins with; each field of it expects twice that of the one before."""
MOST_INVERTED = 0.001
STRAIN = "finite strain"
"""Name of the choice between linear and finite strain."""
GAIN = 0.95
"""A refinement is kept if it brings the misfit at held-out keypoints below this share of what it was."""


@dataclass(frozen=True)
class Refinement:
    """A refinement that was tried. before_mm, after_mm: median misfit at the held-out keypoints, without and with it;
    kept: whether it became part of the model.
    """

    name: str
    before_mm: float
    after_mm: float
    kept: bool


@dataclass(frozen=True)
class CollapseModel:
    """The collapse by mechanics. displacement: (n, 3) mm at the nodes of system.mesh, correction included.

    correspondences: keypoints matched in both CBCTs, in the deflated one's frame: `moving` before the collapse (placed
    by the spine), `fixed` after it; refinements: those tried beyond the plain fit; solid: which strain measure the
    plain fit ended with, and why; ensemble: (k, n, 3) mm, what other estimates differ from `displacement` by. With a
    refinement the other estimate is the training-only model, without one there are those of `perturbation_ensemble`.
    """

    system: PoroSystem
    fit: Fit
    displacement: Array
    correspondences: Correspondences
    refinements: tuple[Refinement, ...]
    solid: StrainChoice
    ensemble: Array

    @property
    def is_refined(self) -> bool:
        """Whether a refinement was kept."""
        return any(refinement.kept for refinement in self.refinements)

    @property
    def held_out_mm(self) -> float | None:
        """Median misfit at the held-out keypoints of the training-only model; None where no refinement was tried."""
        if not self.refinements:
            return None
        kept = [refinement.after_mm for refinement in self.refinements if refinement.kept]
        return kept[-1] if kept else self.refinements[0].before_mm


Step = Callable[[CollapseModel, Target, Fit], CollapseModel]
"""Makes a model with a refinement from a model, the data to fit and a fit to start from."""


def select_model(
    gravity: Array, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages
) -> CollapseModel:
    """Fit the collapse to what was observed, and keep those refinements that predict held-out keypoints better."""
    with stages.stage(SET_UP):
        still = stages.done(partial(still_lung, observed.model_mesh, Tissue(), gravity, observed.hilum_nodes))
        system = replace(still, hilum_displacement=observed.motion.displacement)
    surface = surface_target(observed.surface)
    with stages.stage("fit"):
        plain = fit_collapse(system, surface, fit_settings(settings))
        within = LinearRange(share=settings.leave_out.strained_share)
        solid = keep_in_range(system, plain.state, neo_hookean(system.tissue), within)
    is_finite = solid.strain is Strain.FINITE
    stages.choose(Choice(STRAIN, is_finite, solid.why, solid.share, within.share))
    start = CollapseModel(
        system, replace(plain, state=solid.state), solid.state.u, NO_CORRESPONDENCES, (), solid, NO_ENSEMBLE
    )
    model, training_only = refined_model(start, surface, prepared, observed, settings, stages)
    if training_only.displacement is not model.displacement:
        return replace(model, ensemble=(training_only.displacement - model.displacement)[None])
    with stages.stage("perturbation ensemble"):
        return replace(model, ensemble=perturbation_ensemble(system, surface, plain, fit_settings(settings)))


def refined_model(
    model: CollapseModel, surface: Target, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages
) -> tuple[CollapseModel, CollapseModel]:
    """The model with the refinements that were kept, fitted to all keypoints, and the same training-only."""
    if not settings.keypoints.on:
        stages.skip("keypoints", "switched off in the settings")
        return model, model
    with stages.stage("keypoints"):
        found = find_correspondences(prepared, observed, model.displacement, settings.keypoints)
        model = replace(model, correspondences=found)
    training_only, why = model, too_few(model.correspondences)
    if why:
        stages.skip("regional fit", why)
        return model, model
    if settings.model.regional:
        with stages.stage("regional fit"):
            steps = {"regional fit": _regional(model.system, settings)}
            model, training_only = select_refinement(steps, model, training_only, surface, or_trial=True)
    if settings.model.correct:
        with stages.stage("elastic correction"):
            fields = Corrections(fit_settings(settings))
            steps = {
                f"elastic correction, strain {strain:g}": corrected(strain, fields) for strain in CORRECTION_STRAINS
            }
            model, training_only = select_refinement(steps, model, training_only, surface, begin=fields.begin)
            if not any(refinement.kept for refinement in model.refinements if refinement.name in steps):
                steps = {
                    f"elastic correction, strain {strain:g}, held back": held_back(strain, fields)
                    for strain in CORRECTION_STRAINS
                }
                model, training_only = select_refinement(steps, model, training_only, surface)
    return model, training_only


def select_refinement(
    steps: dict[str, Step],
    model: CollapseModel,
    training_only: CollapseModel,
    surface: Target,
    or_trial: bool = False,
    begin: Callable[[CollapseModel, Target], Callable[[], object]] | None = None,
) -> tuple[CollapseModel, CollapseModel]:
    """Try each step on the training-only model, which is fitted without the held-out keypoints.

    begin: begins beside the trials what every step does with all keypoints; what it returns waits for that.

    The step that predicts these best, if better than without it by GAIN, is done again with all keypoints on the model
    itself; where that does not settle, the next best one is. Where none settles and `or_trial` is set, the best trial
    is the model: most of the keypoints have told it where tissue went, and those held out agree.
    """
    mesh, found = model.system.mesh, model.correspondences
    hidden = held_out(found.fixed)
    tested, shown = found.only(hidden), _with_keypoints(surface, found.only(~hidden))
    whole = _with_keypoints(surface, found)
    begun = begin(model, whole) if begin else None
    trials = {name: step(training_only, shown, training_only.fit) for name, step in steps.items()}
    before = misfit(mesh, training_only.displacement, tested)
    after = {name: misfit(mesh, trial.displacement, tested) for name, trial in trials.items() if _settled(trial)}
    best = None
    better = sorted((name for name, mm in after.items() if mm < GAIN * before), key=lambda name: after[name])
    if better and begun:
        begun()
    for name in better:
        refined = steps[name](model, whole, trials[name].fit)
        if refined is not model and _settled(refined):
            best, model, training_only = name, refined, trials[name]
            break
    if best is None and better and or_trial:
        best, model, training_only = better[0], trials[better[0]], trials[better[0]]
    refinements = (*model.refinements, *(Refinement(name, before, mm, name == best) for name, mm in after.items()))
    return replace(model, refinements=refinements), training_only


def _settled(model: CollapseModel) -> bool:
    return model.fit.status is not FitStatus.CONTACT and model.fit.state.status is not PoroStatus.NOT_CONVERGED


NO_CORRESPONDENCES = Correspondences.none()
NO_ENSEMBLE = np.zeros((0, 0, 3))


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


def _with_keypoints(target: Target, found: Correspondences) -> Target:
    return replace(target, inflated=found.moving, deflated=found.fixed, keypoint_weights=found.weights)


def misfit(mesh: TetMesh, displacement: Array, found: Correspondences) -> float:
    """Median distance in mm between where displacements (n, 3) of a mesh put keypoints and where they were matched."""
    moved = found.moving + interpolate(locate(mesh, found.moving), displacement)
    return float(np.median(np.linalg.norm(moved - found.fixed, axis=1)))


def _regional(plain: PoroSystem, settings: Settings) -> Step:
    """Uniform strains of the resting shape, and the hilum's position, as further parameters of the fit."""
    modes = uniform_strain_modes(plain.mesh, plain.tissue)
    modes += hilum_modes(plain.mesh, plain.hilum) if settings.model.hilum else ()
    system = replace(plain, modes=modes)

    def step(model: CollapseModel, target: Target, start: Fit) -> CollapseModel:
        theta = start.theta
        chosen = replace(
            fit_settings(settings, len(modes)), starts=((theta.kappa_b, theta.phi, theta.d_diaph_mm, *theta.modes),)
        )
        found = fit_collapse(system, target, chosen)
        return replace(model, system=system, fit=found, displacement=found.state.u)

    return step


class Corrections:
    """Elastic corrections of models towards targets, each series from the stiffest one on, as far as is asked for."""

    def __init__(self, settings: FitSettings) -> None:
        self.settings = settings
        self._series: list[_Series] = []

    def begin(self, model: CollapseModel, target: Target) -> Callable[[], object]:
        """Begin all that are tried on another thread; what is returned waits for them."""
        return ahead(partial(self.field, max(CORRECTION_STRAINS), model, target))

    def field(self, strain: float, model: CollapseModel, target: Target) -> ElasticCorrection:
        """The one that expects a strain of STIFFEST times a power of two."""
        series = next((s for s in self._series if s.model is model and s.target is target), None)
        if series is None:
            mesh, u = model.system.mesh, model.displacement
            wanted = constraints_to(target, mesh, u, self.settings)
            series = _Series(model, target, loosened(mesh, u, model.system.tissue, wanted, STIFFEST), [])
            self._series.append(series)
        number = round(np.log2(strain / STIFFEST))
        while len(series.found) <= number:
            series.found.append(next(series.fields))
        return series.found[number]


@dataclass(frozen=True)
class _Series:
    """Elastic corrections of a model towards a target. fields: makes them; found: those that were made."""

    model: CollapseModel
    target: Target
    fields: Iterator[ElasticCorrection]
    found: list[ElasticCorrection]


def corrected(strain: float, corrections: Corrections) -> Step:
    """An elastic field on top; the model unchanged where that would invert more elements."""

    def step(model: CollapseModel, target: Target, _start: Fit) -> CollapseModel:
        found = corrections.field(strain, model, target)
        inverted, before = ((det <= 0).mean() for det in (found.det_f, model.fit.state.det_f))
        if inverted > max(before, MOST_INVERTED):
            return model
        return replace(model, displacement=model.displacement + found.u)

    return step


def held_back(strain: float, corrections: Corrections) -> Step:
    """The same field, made smaller at the nodes of elements that it would invert."""

    def step(model: CollapseModel, target: Target, _start: Fit) -> CollapseModel:
        now, mesh = model.displacement, model.system.mesh
        field = unfolded(mesh.points + now, corrections.field(strain, model, target).u, mesh.tets)
        return replace(model, displacement=now + field)

    return step
