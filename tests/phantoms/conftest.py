"""One demo case, made once for all tests of truth."""

from __future__ import annotations

import pytest

from phantoms import PhantomCase, make_case


@pytest.fixture(scope="session")
def demo() -> PhantomCase:
    return make_case("demo", seed=0)
