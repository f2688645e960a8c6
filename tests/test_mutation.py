"""The mutation script: each operator makes the change it says, draws repeat, verdicts are right and taken up again."""

from __future__ import annotations

import ast
import json
import os
import time
from pathlib import Path

import pytest

from tests import mutation
from tests.faults import copies
from tests.faults.imports import Imports
from tests.faults.mutants import OPERATORS, Mutant, mutants, sibling_fields
from tests.faults.table import Record, table
from tests.faults.warm import Suite

CHANGES = [
    ("comparison", "a < b", ["a <= b", "a > b"]),
    ("comparison", "a >= b", ["a > b", "a <= b"]),
    ("comparison", "a == b != c", ["a != b != c", "a == b == c"]),
    ("comparison", "a is not b", ["a is b"]),
    ("comparison", "a in b", ["a not in b"]),
    ("arithmetic", "(a + b) - c", ["(a + b) + c", "(a - b) - c"]),
    ("arithmetic", "a * b / c", ["a * b * c", "a / b / c"]),
    ("arithmetic", "a += b", ["a -= b"]),
    ("arithmetic", "folder / 'name'", []),
    ("connective", "a and b and c", ["a or b and c", "a and b or c"]),
    ("connective", "a & b | c", ["a & b & c", "a | b | c"]),
    ("arguments", "f(a, b + 1, x=c, y=d)", ["f(b + 1, a, x=c, y=d)", "f(a, b + 1, x=d, y=c)"]),
    ("arguments", "f((a + b) * c, d)", ["f(d, (a + b) * c)"]),
    ("arguments", "f('text', a, progress=b, x=c)", []),
    ("arguments", "min(a, b)", []),
    ("index", "a[0], a[-1], a[1]", ["a[-1], a[-1], a[1]", "a[0], a[0], a[1]"]),
    ("index", "a[:, 0]", ["a[:, -1]"]),
    ("transpose", "(a @ b).T", ["(a @ b)"]),
    ("transpose", "a.transpose(0, 2, 1) + 1", ["a + 1"]),
    ("transpose", "np.transpose(a)", []),
    ("inverse", "f(pose).inverse() @ a", ["f(pose) @ a"]),
    ("inverse", "np.linalg.inv(a)", ["(a)"]),
    ("negation", "a and not b", ["a and b"]),
    ("negation", "not (a)", ["(a)"]),
    ("negation", "a & ~b", ["a & b"]),
    ("extreme", "np.min(a)", ["np.max(a)"]),
    ("extreme", "max(a, b.argmin())", ["min(a, b.argmin())", "max(a, b.argmax())"]),
    ("constant", "a * 3", ["a * 6", "a * 4", "a * (-3)"]),
    ("constant", "a - 0.5", ["a - 1.0", "a - 1.5", "a - (-0.5)"]),
    ("constant", "a[1], 0", ["a[1], 1"]),
    ("attribute", "a.first.name", ["a.second.name"]),
    ("truth", "f(x=True)", ["f(x=False)"]),
]
UNCHANGED = '''"""Of 3 words."""
from __future__ import annotations
__all__ = ["a"[0]]
if TYPE_CHECKING:
    a = 1 + 1
def f(x: Annotated[int, 1], progress=None) -> tuple[1]:
    """Of 3 words."""
    if progress is not None:
        progress(f"{x + 1}", 1 / 2)
    raise ValueError(f"{x} is not {x + 1}", x < 2)
@njit(cache=True)
class Pair:
    x: Annotated[int, 1]
    def __repr__(self):
        return 1 + 1
'''
AGES = """def adult(age):
    return age >= 18


def first(found):
    return found[0]
"""
TEST_AGES = """from ages import adult


def test_adult():
    assert adult(20)
    assert not adult(18 - 1)
"""
DEMO = """from ages import adult, first


def test_demo():
    assert adult(18)


def test_killed():
    raise AssertionError
"""


def after(operator: str, text: str) -> list[str]:
    """The text with each fault of one operator in it."""
    found = mutants("module.py", text, {"first": {"second"}})
    return [mutant.plant(text) for mutant in found if mutant.operator == operator]


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A small project: the test lets the limit of `adult` and all of `first` go, the demo lets only `first` go."""
    root = tmp_path / "project"
    for file, text in {
        "ages.py": AGES,
        "tests/test_ages.py": TEST_AGES,
        mutation.DEMO: DEMO,
        "pyproject.toml": '[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n',
    }.items():
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        (root / file).write_text(text)
    return root


@pytest.mark.parametrize(("operator", "text", "expected"), CHANGES)
def test_operator_changes_what_it_says(operator: str, text: str, expected: list[str]) -> None:
    assert after(operator, text) == expected


def test_every_operator_is_tested() -> None:
    assert {operator for operator, _, _ in CHANGES} == set(OPERATORS)


def test_text_annotations_progress_and_decorators_are_left_alone() -> None:
    assert mutants("module.py", UNCHANGED) == []


def test_other_lines_stay_where_they_are() -> None:
    text = "a = (\n    größe  # + is meant\n    + b\n    .T\n)\nc = f(\n    a,  # first\n    b,\n)\n"
    found = [mutant.plant(text) for mutant in mutants("module.py", text)]
    assert found == [
        text.replace("    + b", "    - b"),
        text.replace("    .T\n", "    \n"),
        text.replace("a,  # first\n    b", "b,  # first\n    a"),
    ]
    assert [mutant.line for mutant in mutants("module.py", text)] == [3, 4, 7]


def test_siblings_are_fields_of_one_type_in_a_frozen_dataclass() -> None:
    fields = ("first: A", "size: int", "other: B", "second: A", "count: int")
    text = "\n    ".join(["@dataclass(frozen=True)\nclass Pair:", *fields])
    assert sibling_fields([ast.parse(text)]) == {"first": {"second"}, "second": {"first"}, "count": {"size"}}
    assert sibling_fields([ast.parse(text.replace("(frozen=True)", ""))]) == {}


def test_a_draw_repeats_and_a_larger_one_adds_to_it() -> None:
    text = "\n".join(f"x = {a} + y[0]" for a in range(20))
    found = mutants("module.py", text)
    assert mutation.drawn(found, 30, 0) == mutation.drawn(found, 30, 0)
    assert mutation.drawn(found, 30, 0)[:20] == mutation.drawn(found, 20, 0)
    assert mutation.drawn(found, 30, 0) != mutation.drawn(found, 30, 1)
    everything = mutation.drawn(found, 1000, 0)
    assert len({(mutant.start, mutant.end) for mutant in everything}) == len(everything) == 60
    assert [mutant.operator for mutant in everything[:4]] == ["arithmetic", "constant", "index", "arithmetic"]


def test_scope_names_files_that_are_there(tree: Path) -> None:
    files = mutation.in_scope(mutation.ROOT, mutation.SCOPE)
    assert files["vatsloc/workflow/localize.py"] == ()
    assert files["vatsloc/workflow/stages.py"] is None
    assert (mutation.ROOT / mutation.DEMO).is_file()
    with pytest.raises(SystemExit, match=r"no file is gone\.py"):
        mutation.in_scope(tree, {"ages.py": (), "gone.py": ()})


def test_tests_are_found_by_their_imports_nearest_and_narrowest_first(tmp_path: Path) -> None:
    for file, text in {
        "pack/__init__.py": "from pack.inner import f",
        "pack/inner.py": "from far import g\ndef f(): return g()",
        "far.py": "from farther import h\ndef g(): return h()",
        "farther.py": "def h(): return 1",
        "alone.py": "",
        "tests/scenes.py": "from pack import f",
        "tests/test_near.py": "from pack import f",
        "tests/test_scene.py": "from scenes import f",
        "tests/test_other.py": "import alone",
    }.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    imports = Imports(tmp_path)
    near, scene = "tests/test_near.py", "tests/test_scene.py"
    assert mutation.within_reach(imports, "pack/inner.py") == {near: 1, scene: 2}
    assert mutation.within_reach(imports, "far.py") == {near: 2}
    assert mutation.within_reach(imports, "farther.py") == {near: 3}
    steps = {scene: 1, "tests/test_other.py": 1, near: 1, "pack/inner.py": 2, "far.py": 1}
    expected = ["far.py", "tests/test_other.py", near, scene, "pack/inner.py"]  # those of a step by what they reach
    assert mutation.first_in_turn(imports, steps) == expected
    assert mutation.first_in_turn(imports, dict.fromkeys(imports.trees, 1))[:1] == ["alone.py"]


def test_kernels_are_stale_with_what_they_hold(tmp_path: Path) -> None:
    kernel = "from numba import njit\nfrom a import f, Array\n@njit\ndef {0}(x: Array):\n    return {1}(x)\n"
    (tmp_path / "a.py").write_text("from numba import njit\nArray = 1\n@njit\ndef f(x):\n    return x\n")
    (tmp_path / "b.py").write_text(kernel.format("g", "f"))
    (tmp_path / "c.py").write_text(kernel.format("h", "g").replace("from a import f", "from b import g"))
    (tmp_path / "d.py").write_text(kernel.format("i", "abs"))
    imports = Imports(tmp_path)
    assert imports.compiled_with("a.py") == {"a.py", "b.py", "c.py"}
    assert imports.compiled_with("c.py") == {"c.py"}


def test_a_planted_fault_goes_and_what_was_compiled_comes_back(tree: Path) -> None:
    cache = tree / "__pycache__"
    cache.mkdir()
    for name in ("ages.adult-1.py311.nbi", "others.f-1.py311.nbi"):
        (cache / name).write_text("old")
    os.utime(tree / "ages.py", (1, 1))
    mutant = mutants("ages.py", AGES)[0]
    with copies.planted(tree, mutant, ["ages.py"]):
        assert (tree / "ages.py").read_text() == AGES.replace(">=", ">")
        assert [path.name for path in cache.iterdir()] == ["others.f-1.py311.nbi"]
        (cache / "ages.adult-1.py311.nbi").write_text("new")
        (cache / "ages.adult-1.py311.1.nbc").write_text("new")
    assert (tree / "ages.py").read_text() == AGES
    assert (tree / "ages.py").stat().st_mtime == 1
    assert {path.name: path.read_text() for path in cache.iterdir()} == {
        "ages.adult-1.py311.nbi": "old",
        "others.f-1.py311.nbi": "old",
    }


def test_verdicts_are_right_and_are_taken_up_again(tree: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def run(*words: str) -> list[Record]:
        command = ["--out", str(out), "--only", "*.py", "--seed", "3", "--warm", "", *words]
        mutation.main(command, tree, {"ages.py": (), "tests/*.py": None})
        return [json.loads(line) for line in (out / "mutants.jsonl").read_text().splitlines()]

    assert run("--number", "1", "--within", "elsewhere/*") == []
    (first,) = run("--number", "1")
    assert (first["operator"], first["after"], first["verdict"]) == ("comparison", ">", "survived")
    again, second, first_by_demo = run("--number", "2", "--end-to-end", "--jobs", "2")
    assert again == first
    assert (second["operator"], second["verdict"]) == ("constant", "killed")
    assert second["by"] == "tests/test_ages.py::test_adult"
    assert first_by_demo == first | {"demo": f"{mutation.DEMO}::test_demo"}
    assert (tree / "ages.py").read_text() == AGES
    assert not list(tree.rglob("__pycache__"))
    assert "Killed: " in (out / "table.md").read_text()


def test_a_mutant_that_hangs_is_ended_in_time(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copies, "COMPILING_S", 2.0)
    text = AGES.replace("    return age", "    while age < 0:\n        pass\n    return age")
    (tree / "ages.py").write_text(text)
    (mutant,) = (mutant for mutant in mutants("ages.py", text) if mutant.after == ">" and mutant.before == "<")
    start = time.monotonic()
    with Suite(tree) as suite:
        assert copies.judge(suite, mutant, ["ages.py"], ["tests/test_ages.py"], 0.0)["verdict"] == "timeout"
    assert time.monotonic() - start < 60


def test_tests_that_fail_without_a_fault_end_the_run_unless_left_out(tree: Path, tmp_path: Path) -> None:
    (tree / "tests" / "test_ages.py").write_text(TEST_AGES.replace("assert not", "assert"))
    (tree / "tests" / "test_first.py").write_text(
        "from ages import first\n\n\ndef test_first(): assert first([1]) == 1\n"
    )
    words = ["--out", str(tmp_path), "--number", "1", "--warm", ""]
    with pytest.raises(SystemExit, match="mend them first"):
        mutation.main(words, tree, {"ages.py": ()})
    mutation.main([*words, "--deselect", "tests/test_ages.py::test_adult"], tree, {"ages.py": ()})
    (record,) = map(json.loads, (tmp_path / "mutants.jsonl").read_text().splitlines())
    assert (record["operator"], record["verdict"]) == ("comparison", "survived")


def test_a_fault_that_no_conftest_can_be_imported_with_is_a_kill(tree: Path) -> None:
    (tree / "tests" / "conftest.py").write_text("from ages import adult\nassert adult(18)\n")
    mutant = next(mutant for mutant in mutants("ages.py", AGES) if mutant.after == ">")
    with Suite(tree) as suite:
        said = copies.judge(suite, mutant, ["ages.py"], ["tests/test_ages.py"], 1.0)
    assert said["verdict"] == "killed"
    assert "conftest.py" in said["by"]


def test_what_does_not_compile_is_no_kill(tree: Path) -> None:
    mutant = Mutant("ages.py", 1, 0, "truth", "def", "(", "def adult(age):", 0, 3)
    with Suite(tree) as suite:
        verdict = copies.judge(suite, mutant, ["ages.py"], ["tests/test_ages.py"], 1.0)
    assert verdict["verdict"] == "does not compile"


def test_table_tells_judged_survivors_from_others() -> None:
    mutant = {"file": "a.py", "line": 3, "column": 4, "operator": "connective", "before": "|", "after": "&"}
    alive = mutant | {"source": "x = a | b", "verdict": "survived"}
    records = [
        alive,
        alive | {"line": 5, "source": "y = b | a", "demo": "survived"},
        alive | {"line": 7, "source": "y = c | a", "demo": "tests/t.py::test_demo"},
        *(mutant | {"line": line, "verdict": "killed"} for line in range(10, 14)),
        mutant | {"line": 20, "verdict": "timeout"},
        mutant | {"line": 21, "verdict": "does not compile"},
    ]
    text = table(records, [{"file": "a.py", "source": "x = a | b", "operator": "connective", "why": "Same."}], 7)
    assert "9 mutants from seed 7, 1 of which do not compile." in text
    assert "Killed: 5 of 8 (62.5%), 1 of them by a timeout. Survivors: 3, 1 of them judged." in text
    assert "The demo run kills 1 of 2 survivors put to it." in text
    assert "| connective | 5 | 8 |" in text
    assert "| `a.py:3` | connective | `x = a \\| b` | `\\|` to `&` | not run | Same. |" in text
    assert "| `a.py:5` | connective | `y = b \\| a` | `\\|` to `&` | survived | **no** |" in text
