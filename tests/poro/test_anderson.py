"""Anderson's acceleration against the plain iteration, on a map of known rates."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from poro.linalg import Anderson
from poro.linalg.anderson import DEPTH


def test_a_linear_map_of_few_rates_ends_in_as_many_steps() -> None:
    """A fixed point of rates 0.9, -0.5 and 0.3 is met after four steps; a companion that goes along meets its own."""
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(20, 20)))[0]
    rates = basis[:, :3] @ np.diag([0.9, -0.5, 0.3]) @ basis[:, :3].T
    end, carry = rng.normal(size=20), rng.normal(size=(7, 20))
    x, anderson, steps = np.zeros(20), Anderson(), 0
    while np.linalg.norm(rates @ (x - end) + end - x) > 1e-9:
        following = end + rates @ (x - end)
        x, beside = anderson.mix(following - x, following, carry @ following)
        assert_allclose(beside, carry @ x, atol=1e-8)
        steps += 1
    assert_allclose(x, end, atol=1e-7)
    assert steps <= 5


def test_a_restart_gives_the_plain_step_back() -> None:
    anderson = Anderson()
    for k in range(DEPTH + 3):
        anderson.mix(np.array([1.0 / (k + 1), 0.2 * k]), np.array([float(k), 1.0]))
    anderson.restart()
    following = np.array([3.0, 4.0])
    (mixed,) = anderson.mix(np.array([0.1, 0.2]), following)
    assert_allclose(mixed, following)
