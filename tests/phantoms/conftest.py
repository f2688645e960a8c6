"""Two cases, made once for all tests of truth: the demo's lung in one piece, and one whose lobes slide."""

from __future__ import annotations

import pytest

from phantoms import PhantomCase, PhantomSpec, make_case
from phantoms.spec import Collapse

LOBED = PhantomSpec(
    "lobed",
    "right",
    ct_spacing=(3.0, 3.0, 3.0),
    cbct_spacing=(3.0, 3.0, 3.0),
    element=24.0,
    fused=0.1,
    collapse=Collapse(shift=24.0, lobes_apart=0.1),
)


@pytest.fixture(scope="session")
def demo() -> PhantomCase:
    return make_case("demo", seed=0)


@pytest.fixture(scope="session")
def lobed() -> PhantomCase:
    return make_case(LOBED, seed=6)


@pytest.fixture(params=["demo", "lobed"])
def case(request: pytest.FixtureRequest) -> PhantomCase:
    """Either of the two."""
    made: PhantomCase = request.getfixturevalue(request.param)
    return made
