"""Errors along a breathing series with truth in every state, by value."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.poro.breathing_shapes import pear
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.motion import IN, OUT, LungMotion, Motion
from vatsloc.study.bench.breath_series import Series, errors, series_table

VOLUME = np.array([1.0, 0.5, 0.0, 0.5, 1.0])
UP = np.array([0.0, 0.0, 1.0])


def series() -> Series:
    """Tissue rises 10 mm to the expiration; halfway it has risen 6, on the way in as on the way out."""
    points = pear().points[:40]
    truth = np.stack([points + rise * UP for rise in (0.0, 6.0, 10.0, 6.0, 0.0)])
    return Series(BreathCase("s", Path(), None, None, None, None), VOLUME, truth)


@pytest.mark.parametrize(
    ("direction", "rises"), [(OUT, (0.0, 5.0, 9.0, 5.0, 0.0)), (IN, (-9.0, -4.0, 0.0, -4.0, -8.5))]
)
def test_errors_of_ends_phases_and_loop(direction: str, rises: tuple[float, ...]) -> None:
    mesh = pear()
    if direction == IN:
        mesh = type(mesh)(mesh.points + 10.0 * UP, mesh.tets)
    lung = LungMotion("right", mesh, tuple(mesh.points + rise * UP for rise in rises))
    found = errors(Motion("surface", direction, (lung,), (0.0,) * 5, 2 if direction == OUT else 0), series())
    assert found["initial_mean"] == pytest.approx(10.0)
    assert found["mean"] == pytest.approx(1.0)
    phases = found["phases"]
    assert phases["n"] == 2
    assert phases["mean"] == pytest.approx(1.0 if direction == OUT else 0.0)
    assert phases["straight"] == pytest.approx(1.5 if direction == OUT else 0.5)
    assert phases["straight_between_true_ends"] == pytest.approx(1.0)
    assert found["loop"] == pytest.approx(0.0 if direction == OUT else 0.5, abs=1e-9)
    row = {**found, "name": "s", "driver": "surface", "by": "masks", "seconds": 1.0}
    assert len(series_table([row])) == 2
