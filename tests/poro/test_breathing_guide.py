"""What is known of a lung's motion drives its models: at no energy where tissue can follow, and by value and sign."""

from __future__ import annotations

import numpy as np
import pytest
from breathing_shapes import pear
from numpy.testing import assert_allclose

from poro.breathing.cavity import inflating
from poro.breathing.elastic import Lung
from poro.breathing.guide import guide
from poro.breathing.inflation import fill
from poro.breathing.one_scan import one_scan
from poro.mesh import TetMesh

STRETCH = np.array([1.03, 1.05, 1.08])
SHIFT = np.array([1.0, -2.0, 3.0])


def test_a_linear_motion_satisfies_its_guide_exactly_and_far_points_say_nothing() -> None:
    mesh = pear()
    inside = mesh.points[mesh.tets].mean(axis=1)
    points = np.concatenate([inside, [[500.0, 0.0, 0.0]]])
    u, wanted = mesh.points * (STRETCH - 1) + SHIFT, points * (STRETCH - 1) + SHIFT
    wanted[-1] = 99.0
    terms = guide(mesh, points, wanted, np.full(len(points), 100.0))
    unbalanced = terms.force - (terms.matrix @ u.ravel()).reshape(-1, 3)
    assert_allclose(unbalanced, 0, atol=1e-9)
    assert np.abs(terms.force).max() > 1.0


@pytest.mark.parametrize("driver", ["pressure-volume", "one-scan"])
def test_a_driver_follows_what_is_known(driver: str) -> None:
    rest = pear()
    goal = TetMesh(rest.points * STRETCH + SHIFT, rest.tets)
    motion = goal.points - rest.points
    known = guide(rest, rest.points, motion, rest.node_volumes)
    if driver == "one-scan":
        breath = float(goal.volumes.sum() - rest.volumes.sum())
        scene = one_scan(rest, "right").guided(known, breath)
        u = scene.states([float(rest.volumes.sum()) + breath])[0].u
    else:
        filling = inflating(Lung("right", goal, rest), known)
        u = list(fill(filling.at, [0.5, 1.0], filling.volume, filling.guess))[-1].u
    left = np.linalg.norm(u - motion, axis=1)
    assert left.mean() < 0.15 * np.linalg.norm(motion, axis=1).mean()
