"""Models, fits and keypoints of the ball scene for the tests of model selection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from poro.collapse import PoroStatus, Theta
from poro.fit import Fit, FitStatus, Target
from poro.mesh import TetMesh
from registration.correspondences import Correspondences
from registration.volume import Array
from tests.vatsloc import ball_scene as scene
from vatsloc.workflow.model_selection import (
    NO_ENSEMBLE,
    CollapseModel,
    Refinement,
)

GRAVITY = np.array([1.0, 0.0, 0.0])
HILUM = np.array([5, 3, 40, 17, 60])
HILUM_MM = np.arange(15.0).reshape(5, 3)


def mesh() -> TetMesh:
    return scene.placed(scene.lung_mesh(14.0), scene.INF_FROM_CT, scene.DEF_FROM_INF)


def motion(points: Array) -> Array:
    return np.asarray(scene.collapsed(points) - points)


def pairs_of(count: int = 400, seed: int = 5) -> Correspondences:
    """Keypoints that move by the scene's collapse."""
    x = scene.CENTRE_DEF + np.random.default_rng(seed).uniform(-19, 19, (count, 3))
    # Far enough from each other that some blocks of 40 mm are held out and others are not.
    return Correspondences.of(scene.collapsed(x), x)


def a_fit(displacement: Array, settled: bool = True, tets: int = 1, inverted: float = 0.0) -> Any:
    det = np.where(np.arange(tets) < inverted * tets, -1.0, 1.0)
    state = SimpleNamespace(u=displacement, det_f=det, status=PoroStatus.SOLVED)
    if not settled:
        state.status = PoroStatus.NOT_CONVERGED
    return _Fit(Theta(1e-7, 0.6, 3.0), state)


@dataclass(frozen=True)
class _Fit:
    """What model selection reads of a fit."""

    theta: Theta
    state: Any
    status: FitStatus = FitStatus.CONVERGED


def a_model(
    share: float = 0.0, pairs: Correspondences | None = None, refinements: tuple[Refinement, ...] = ()
) -> CollapseModel:
    """A model that knows a share of the collapse."""
    lung: Any = mesh()
    system: Any = SimpleNamespace(mesh=lung, gravity=GRAVITY, hilum=HILUM, tissue=None)
    u = share * motion(lung.points)
    nothing: Any = None
    return CollapseModel(system, a_fit(u), u, pairs_of() if pairs is None else pairs, refinements, nothing, NO_ENSEMBLE)


def knows(share: float, **change: Any) -> Any:
    """A step to a model that knows a share of the collapse."""

    def step(model: CollapseModel, target: Target, start: Fit) -> CollapseModel:
        return replace(model, displacement=share * motion(model.system.mesh.points), **change)

    return step


def a_surface() -> Target:
    found = scene.air_surface(30)
    return Target(found.points, found.normals, found.confidence)
