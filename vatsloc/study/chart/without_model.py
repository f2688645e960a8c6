"""The collapse without the poroelastic model, as variants that say what it is worth: an elastic lung that follows the
surface and the keypoints, and a smooth map through both that knows no mechanics at all.

Neither has pressure, weight, a wall to slide on or a diaphragm. Both then go through the same residual registration,
cut and block refinement as the model does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.interpolate import RBFInterpolator

from poro.breathing.affine import affine_to_points
from poro.collapse import PoroStatus, PoroSystem, StrainMeasure, Theta, assemble, solve
from poro.collapse.choice import StrainChoice
from poro.fem import Tissue
from poro.fit import Fit, FitStatus, PointConstraints, Target, constraints_to, elastic_correction
from poro.mesh import TetMesh, interpolate, locate
from poro.mesh.tetmesh import signed_volumes
from registration.correspondences import Correspondences
from registration.volume import Array
from vatsloc.workflow.hold_out import held_out, too_few
from vatsloc.workflow.keypoints import find_correspondences
from vatsloc.workflow.model_selection import (
    NO_CORRESPONDENCES,
    NO_ENSEMBLE,
    CollapseModel,
    Refinement,
    fit_settings,
    misfit,
    refined_model,
    surface_target,
)
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.prepare import Prepared
from vatsloc.workflow.settings import Settings
from vatsloc.workflow.stages import Stages

Select = Callable[[Array, Prepared, Observed, Settings, Stages], CollapseModel]
"""A model of the collapse that is called as `select_model` is."""
STRAIN = 0.2
"""By how much an elastic lung is expected to strain: a lung that halves its volume shrinks by a fifth."""
ROUNDS = 8
"""How often a lung is laid on the surface again from where the last time left it."""
HILUM_SIGMA_MM = 1.0
SMOOTHING = (1.0, 10.0, 100.0)
"""Smoothing of the spline, of which hold-out chooses."""
NEIGHBOURS = 80


def elastic_lung(
    gravity: Array, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages
) -> CollapseModel:
    """An elastic lung without pressure and weight, held at the hilum, laid on the visible surface by springs along its
    normals, then corrected towards the keypoints by hold-out as the poroelastic one is."""
    surface = surface_target(observed.surface)
    with stages.stage("elastic lung"):
        u = laid_on(surface, observed, settings)
    start = _as_model(gravity, observed, u, "an elastic lung laid on the surface")
    without_regions = settings.model_copy(update={"model": settings.model.model_copy(update={"regional": False})})
    return refined_model(start, surface, prepared, observed, without_regions, stages)[0]


def smooth_spline(
    gravity: Array, prepared: Prepared, observed: Observed, settings: Settings, stages: Stages
) -> CollapseModel:
    """No mechanics: an affine map to the visible surface and the hilum, then a thin-plate spline through keypoints,
    hilum and surface, as smooth as held-out keypoints ask for."""
    surface, mesh = surface_target(observed.surface), observed.model_mesh
    with stages.stage("affine map to the surface"):
        u = affine_on(surface, observed, settings)
    model = _as_model(gravity, observed, u, "an affine map to the surface")
    with stages.stage("keypoints"):
        found = find_correspondences(prepared, observed, u, settings.keypoints)
    model, why = replace(model, correspondences=found), too_few(found)
    if why:
        stages.skip("spline", why)
        return model
    with stages.stage("spline"):
        hidden = held_out(found.fixed)
        trials = {}
        for smoothing in SMOOTHING:
            trial = _spline(surface, observed, u, found.only(~hidden), smoothing, settings)
            trials[misfit(mesh, trial, found.only(hidden))] = smoothing
        before_mm, after_mm = misfit(mesh, u, found.only(hidden)), min(trials)
        moved = _spline(surface, observed, u, found, trials[after_mm], settings)
    kept = Refinement(f"spline, smoothing {trials[after_mm]:g}", before_mm, after_mm, True)
    return replace(model, displacement=moved, refinements=(kept,))


def laid_on(surface: Target, observed: Observed, settings: Settings) -> Array:
    """Displacement (n, 3) mm of the elastic lung of least energy whose surface is drawn to the observed one and whose
    hilum moves as observed; nearest points are looked up again `ROUNDS` times."""
    mesh, held = observed.model_mesh, observed.hilum_nodes
    u = np.zeros_like(mesh.points)
    for _ in range(ROUNDS):
        near = constraints_to(surface, mesh, u, fit_settings(settings))
        so_far = interpolate(locate(mesh, near.points), u)
        wanted = PointConstraints(
            np.concatenate([near.points, mesh.points[held]]),
            np.concatenate([near.offset + so_far, observed.motion.displacement]),
            np.concatenate([near.sigma_mm, np.full(len(held), HILUM_SIGMA_MM)]),
            np.concatenate([near.normals, np.zeros((len(held), 3))]),
        )
        u = elastic_correction(mesh, np.zeros_like(u), Tissue(), wanted, STRAIN).u
    return u


def affine_on(surface: Target, observed: Observed, settings: Settings) -> Array:
    """Displacement (n, 3) mm of the affine map that lays the lung on the observed surface and its hilum where it is."""
    mesh, held = observed.model_mesh, observed.hilum_nodes
    u = np.zeros_like(mesh.points)
    for _ in range(ROUNDS):
        at, to = _surface_pairs(surface, observed, u, settings)
        points = np.concatenate([at, mesh.points[held]])
        moved = np.concatenate([to, mesh.points[held] + observed.motion.displacement])
        u = affine_to_points(points, moved)(mesh.points) - mesh.points
    return u


def _surface_pairs(surface: Target, observed: Observed, u: Array, settings: Settings) -> tuple[Array, Array]:
    """Points (q, 3) of the lung's surface at rest, and observed ones (q, 3) that lie nearest to where u puts them."""
    mesh = observed.model_mesh
    near = constraints_to(surface, mesh, u, fit_settings(settings))
    return near.points, near.points + interpolate(locate(mesh, near.points), u) + near.offset


def _spline(
    surface: Target, observed: Observed, u: Array, found: Correspondences, smoothing: float, settings: Settings
) -> Array:
    """Displacement (n, 3) mm at the nodes of a spline through surface, hilum and keypoints."""
    mesh, held = observed.model_mesh, observed.hilum_nodes
    at, to = _surface_pairs(surface, observed, u, settings)
    points = np.concatenate([at, mesh.points[held], found.moving])
    moved = np.concatenate([to - at, observed.motion.displacement, found.fixed - found.moving])
    points, first = np.unique(points, axis=0, return_index=True)
    fitted = RBFInterpolator(points, moved[first], NEIGHBOURS, smoothing, "thin_plate_spline")
    return np.asarray(fitted(mesh.points))


def _as_model(gravity: Array, observed: Observed, u: Array, why: str) -> CollapseModel:
    """A displacement (n, 3) mm in the place of a fitted model; its set-up, which nothing here needs, is not timed."""
    system = assemble(observed.model_mesh, Tissue(), gravity, observed.hilum_nodes, observed.motion.displacement)
    fit = _unfitted(system, u)
    solid = StrainChoice(fit.state, StrainMeasure.LINEAR, why, 0.0, None)
    return CollapseModel(system, fit, u, NO_CORRESPONDENCES, (), solid, NO_ENSEMBLE)


def _unfitted(system: PoroSystem, u: Array) -> Fit:
    """A fit of no parameters whose lung is displaced by u (n, 3) mm."""
    mesh: TetMesh = system.mesh
    theta = Theta(1e-12, 0.5)  # hardly any pressure drop
    det_f = signed_volumes(mesh.points + u, mesh.tets) / mesh.volumes
    return Fit(
        theta=theta,
        state=replace(solve(system, theta), u=u, det_f=det_f, status=PoroStatus.SOLVED),
        covariance=np.zeros((3, 3)),
        sensitivity=np.zeros((*u.shape, 3)),
        surface_rms_mm=float("nan"),
        keypoint_rms_mm=float("nan"),
        history=(),
        costs=np.zeros(0),
        status=FitStatus.CONVERGED,
        free=np.zeros(3, dtype=bool),
    )
