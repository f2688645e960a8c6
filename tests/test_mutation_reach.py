"""Which functions each test enters, by which the mutation script chooses the tests of a mutant."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults import copies
from tests.faults.imports import Imports
from tests.faults.warm import Suite
from tests.test_mutation import AGES

KEPT = """from dataclasses import dataclass
from functools import cached_property, lru_cache


def deep():
    return 1


@lru_cache
def kept():
    return deep()


@dataclass(frozen=True)
class Pair:
    a: int

    @cached_property
    def twice(self):
        return double(self.a)

    def thrice(self):
        return triple(
            self.a
        )


def double(a):
    return 2 * a


def triple(a): return [a * three for three in [3]][0]


def unused():
    return 0


@njit(cache=True)
def kernel():
    return 0


AT_ONCE = triple(2)
"""
TEST_KEPT = """import subprocess, sys, threading

import pytest

from kept import Pair, deep, double, kept, triple


@pytest.fixture(scope="module")
def pair():
    double(1)
    return Pair(2)


def test_first(pair): assert kept() == 1


def test_second(pair): assert pair.twice == 4


def test_third(): assert Pair(1).thrice() == 3


def test_in_a_thread():
    found = []
    thread = threading.Thread(target=lambda: found.append(deep()))
    thread.start()
    thread.join()
    assert found == [1]


def test_elsewhere(): subprocess.run([sys.executable, "-c", ""], check=True)
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A project without tests."""
    root = tmp_path / "project"
    (root / "tests").mkdir(parents=True)
    (root / "ages.py").write_text(AGES)
    (root / "pyproject.toml").write_text('[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n')
    return root


def test_tests_are_told_by_the_functions_that_they_enter(tree: Path) -> None:
    (tree / "kept.py").write_text(KEPT.replace("@njit(cache=True)\n", ""))
    (tree / "tests" / "test_kept.py").write_text(TEST_KEPT)
    imports = Imports(tree)
    with Suite(tree) as suite:
        told = copies.baseline(suite, "tests/test_kept.py")

    def entering(name: str) -> list[str]:
        line = 1 + next(n for n, text in enumerate(KEPT.splitlines()) if text.strip().startswith(f"def {name}("))
        found = copies.entering(told, imports.function("kept.py", line + ("return" not in KEPT.splitlines()[line - 1])))
        return [test.split("::test_")[1] for test, _ in found]

    everything = ["first", "second", "third", "in_a_thread", "elsewhere"]
    assert entering("unused") == ["elsewhere"]
    assert entering("thrice") == ["third", "elsewhere"]
    assert entering("double") == everything, "of a property that is kept"
    assert entering("deep") == everything, "of a function whose result is kept"
    assert entering("triple") == everything, "when the module is imported"


def test_a_fixture_s_functions_are_entered_by_all_that_ask_for_it(tree: Path) -> None:
    (tree / "tests" / "test_fixture.py").write_text(
        "import pytest\nfrom ages import first\n\n@pytest.fixture(scope='module')\ndef one(): return first([1])\n\n"
        "@pytest.fixture\ndef two(one): return 2 * one\n\ndef test_a(one): pass\ndef test_b(): pass\n"
        "def test_c(two): pass\n"
    )
    with Suite(tree) as suite:
        told = copies.baseline(suite, "tests/test_fixture.py")
        line = Imports(tree).function("ages.py", 6)
        only = [name for name, _ in copies.entering(told, line)]
        assert only == ["tests/test_fixture.py::test_a", "tests/test_fixture.py::test_c"]
        assert "2 passed" in suite.run(["tests/test_fixture.py"], only=only)[1]


def test_functions_are_found_by_their_lines(tmp_path: Path) -> None:
    (tmp_path / "kept.py").write_text(KEPT)
    imports = Imports(tmp_path)
    at = {text.strip(): number for number, text in enumerate(KEPT.splitlines(), 1)}
    assert imports.function("kept.py", at["return deep()"]) == f"kept.py:{at['@lru_cache']}"
    assert imports.function("kept.py", at["self.a"]) == f"kept.py:{at['def thrice(self):']}"
    assert imports.function("kept.py", at["a: int"]) is None
    assert imports.function("kept.py", at["AT_ONCE = triple(2)"]) is None
    assert imports.function("kept.py", at["@njit(cache=True)"] + 2) is None
