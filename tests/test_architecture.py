"""Arrows between rooms run one way: what each may import is in the table, and the table has no circle."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

ROOMS: dict[str, dict[str, set[str]]] = {
    "registration": {
        "volume": set(),
        "correspondences": {"volume"},
        "kernels": {"volume"},
        "maps": {"volume", "kernels"},
        "images": {"volume", "kernels", "maps"},
        "keypoints": {"volume", "correspondences", "kernels", "images"},
        "terms": {"volume", "correspondences", "kernels", "maps", "images"},
        "spine": {"volume", "kernels", "maps", "images", "terms"},
        "ffd": {"volume", "correspondences", "maps", "images", "terms"},
        "sliding": {"volume", "correspondences", "maps", "images", "keypoints", "ffd"},
        "verification": {"volume", "keypoints", "maps"},
    },
    "poro": {
        "arrays": set(),
        "errors": set(),
        "linalg": {"arrays", "errors"},
        "mesh": {"arrays"},
        "fem": {"arrays", "errors", "linalg", "mesh"},
        "contact": {"arrays", "errors", "linalg", "mesh"},
        "collapse": {"arrays", "errors", "contact", "fem", "linalg", "mesh"},
        "fit": {"arrays", "collapse", "fem", "mesh"},
        "separation": {"arrays", "contact", "fem", "fit", "linalg", "mesh"},
        "breathing": {"arrays", "errors", "contact", "fem", "linalg", "mesh"},
    },
    "vatsloc": {
        "precompile": set(),
        "errors": set(),
        "frames": set(),
        "lazy": set(),
        "maps": set(),
        "terminal": {"navigation"},
        "formats": {"errors", "frames", "lazy"},
        "imaging": {"errors", "frames", "lazy"},
        "overlap": {"errors"},
        "marks": {"errors", "frames", "formats", "overlap"},
        "calibration": {"errors", "formats", "imaging"},
        "case": {"errors", "frames", "formats", "marks", "imaging", "calibration", "overlap"},
        "new_case": {"errors", "formats", "imaging", "case", "overlap"},
        "results": {"frames", "formats"},
        "report": {"frames", "lazy", "formats", "case", "results"},
        "dicomout": {"errors", "frames", "lazy", "maps", "formats", "case", "results", "report"},
        "navigation": {"errors", "lazy", "formats", "results", "dicomout"},
        "slicer_scene": {"formats", "results", "report"},
        "workflow": {
            *("errors", "frames", "lazy", "maps", "formats", "imaging", "case", "results", "report", "slicer_scene"),
            "dicomout",
        },
        "breathing": {"errors", "frames", "lazy", "maps", "formats", "imaging", "workflow"},
        "dicomnet": {"errors", "lazy", "formats", "imaging", "workflow", "dicomout"},
        "evaluation": {"errors", "frames", "maps", "formats", "imaging", "case", "results", "report"},
        "synthetic": {"errors", "frames", "lazy", "formats", "imaging", "workflow"},
        "study": {
            *("errors", "frames", "lazy", "maps", "terminal", "formats", "imaging", "case", "results", "report"),
            *("workflow", "evaluation", "synthetic", "breathing", "precompile"),
        },
        "listen_command": {"precompile", "terminal", "dicomnet", "workflow"},
        "phantom_command": {"errors", "terminal", "synthetic", "study"},
        "cli": {
            *(
                "errors",
                "terminal",
                "listen_command",
                "phantom_command",
                "new_case",
                "workflow",
                "evaluation",
                "synthetic",
                "study",
            ),
            *("dicomout", "dicomnet", "navigation", "breathing", "precompile"),
        },
        "__main__": {"cli"},
    },
}
"""Package -> room (a folder, or a module beside them) -> rooms of the same package that it may import."""

FOREIGN: dict[str, set[str]] = {
    "registration": {"poro", "phantoms", "vatsloc"},
    "poro": {"registration", "phantoms", "vatsloc"},
    "phantoms": {"registration", "poro", "vatsloc"},
}
"""Package -> packages of ours that it must not know. What phantoms load is tested beside their other tests."""

MAKERS = {"synthetic", "study"}
"""Rooms of vatsloc that may know phantoms. A run and its evaluation do not: they treat a phantom as any other case."""

MOST_ARGUMENTS, MOST_LINES = 8, 350


def imported(file: Path) -> set[str]:
    """Dotted names of the modules that a file imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def room_of(package: str, file: Path) -> str:
    return file.relative_to(ROOT / package).with_suffix("").parts[0]


def files_of(package: str) -> list[Path]:
    """All modules but the package's own front door, which hands on from every room."""
    return [file for file in sorted((ROOT / package).rglob("*.py")) if file != ROOT / package / "__init__.py"]


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_import_what_the_table_lets_them(package: str) -> None:
    strays = []
    for file in files_of(package):
        room = room_of(package, file)
        for module in imported(file):
            top, _, rest = module.partition(".")
            if top == package and rest.split(".")[0] not in ROOMS[package][room] | {room}:
                strays.append(f"{file.relative_to(ROOT)} imports {module}")
    assert strays == []


@pytest.mark.parametrize("package", ROOMS)
def test_the_table_has_every_room_and_no_circle(package: str) -> None:
    assert {room_of(package, file) for file in files_of(package)} == set(ROOMS[package])
    TopologicalSorter(ROOMS[package]).prepare()  # raises CycleError


@pytest.mark.parametrize("package", [*ROOMS, "phantoms"])
def test_modules_import_each_other_in_no_circle(package: str) -> None:
    names = {file: ".".join(file.relative_to(ROOT).with_suffix("").parts) for file in files_of(package)}
    doors = {file: name.removesuffix(".__init__") for file, name in names.items()}
    TopologicalSorter({doors[file]: imported(file) for file in names}).prepare()  # raises CycleError


@pytest.mark.parametrize("package", FOREIGN)
def test_packages_know_nothing_of_those_above_and_beside_them(package: str) -> None:
    known = {module.split(".")[0] for file in (ROOT / package).rglob("*.py") for module in imported(file)}
    assert known & FOREIGN[package] == set()


def test_only_what_makes_phantoms_and_studies_them_knows_them() -> None:
    knowing = {
        room_of("vatsloc", file)
        for file in files_of("vatsloc")
        if any(module.split(".")[0] == "phantoms" for module in imported(file))
    }
    assert knowing == MAKERS


@pytest.mark.parametrize("package", [*ROOMS, "phantoms"])
def test_functions_take_eight_arguments_at_most(package: str) -> None:
    crowded = {}
    for file in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                given = node.args
                names = [arg.arg for arg in given.posonlyargs + given.args + given.kwonlyargs]
                if len([name for name in names if name not in ("self", "cls")]) > MOST_ARGUMENTS:
                    crowded[getattr(node, "name", "lambda")] = str(file.relative_to(ROOT))
    assert crowded == {}


@pytest.mark.parametrize("package", [*ROOMS, "phantoms", "tests"])
def test_files_have_350_lines_at_most(package: str) -> None:
    lines = {
        str(file.relative_to(ROOT)): len(file.read_text("utf-8").splitlines())
        for file in sorted((ROOT / package).rglob("*.py"))
    }
    assert {file: count for file, count in lines.items() if count > MOST_LINES} == {}


@pytest.mark.parametrize("package", ROOMS)
def test_every_front_door_names_what_is_behind_it(package: str) -> None:
    for door in sorted((ROOT / package).rglob("__init__.py")):
        if door.parents[1].name == "study":  # its rooms are commands, not parts for others
            continue
        name = ".".join(door.parent.relative_to(ROOT).parts)
        module = importlib.import_module(name)
        assert module.__doc__, name
        assert module.__all__ == sorted(module.__all__), name
        assert 2 <= len(module.__all__) <= 12, name
        assert all(hasattr(module, entry) for entry in module.__all__), name


def test_vatsloc_s_front_doors_load_nothing_before_they_are_used() -> None:
    doors = [f"vatsloc.{room}" for room in ("formats", "imaging", "workflow", "report", "study", "synthetic")]
    code = f"import sys, {', '.join(doors)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert {"numpy", "numba", "registration", "poro", "phantoms"} & set(loaded.split()) == set()


def test_a_front_door_says_what_it_has_when_asked_for_something_else() -> None:
    with pytest.raises(AttributeError, match="no name 'cure' in this package; it hands on Case, Localization"):
        vars(importlib.import_module("vatsloc"))["__getattr__"]("cure")
