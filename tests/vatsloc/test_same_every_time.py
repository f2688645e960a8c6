"""A run gives the same to the last bit: kernels just compiled or from the cache, one thread or two, a copied case."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from registration.terms.metrics import LocalNcc
from vatsloc.results import OUTPUT_FILES
from vatsloc.synthetic.case import write_phantom

ROOT = Path(__file__).parents[2]
TIMED = ("seconds", "peak_mb", "peak_mb_by_stage")
OF_PLACE = ("report.html", "inputs.json", "scene_with_scans.mrml")
"""Files that tell seconds, or where the case lies."""


def hashes(result: Path) -> dict[str, str]:
    """Of every file but what tells time and place."""
    found = {name: hashlib.sha256((result / name).read_bytes()).hexdigest() for name in OUTPUT_FILES}
    run = json.loads((result / "run.json").read_text(encoding="utf-8"))
    kept = json.dumps({key: value for key, value in run.items() if key not in TIMED}, sort_keys=True)
    found["run.json"] = hashlib.sha256(kept.encode()).hexdigest()
    return {name: digest for name, digest in found.items() if name not in OF_PLACE}


@pytest.mark.study
def test_cold_warm_and_threads_give_the_same_result(tmp_path: Path) -> None:
    case, elsewhere = tmp_path / "demo", tmp_path / "far" / "away"
    write_phantom("demo", case)
    shutil.copytree(case, elsewhere)
    for path in (*elsewhere.glob("landmarks_*"), *elsewhere.glob("truth/*")):
        path.unlink()
    found = {}
    for name, folder, threads in (("cold", case, "1"), ("warm", case, "1"), ("threads", elsewhere, "2")):
        surroundings = os.environ | {
            "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
            "NUMBA_NUM_THREADS": threads,
            "OPENBLAS_NUM_THREADS": threads,
            "OMP_NUM_THREADS": threads,
            "PYTHONPATH": str(ROOT),
        }
        command = [sys.executable, "-m", "vatsloc", "localize", str(folder), "--out", str(tmp_path / name)]
        subprocess.run([*command, "--preset", "fast"], check=True, env=surroundings, capture_output=True)
        found[name] = hashes(tmp_path / name)
    assert found["warm"] == found["cold"]
    assert found["threads"] == found["cold"]


def compiled(package: str) -> list[tuple[Path, ast.FunctionDef, str]]:
    """Functions that numba compiles: file, function, decorator."""
    found = []
    for file in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                found += [(file, node, ast.unparse(d)) for d in node.decorator_list if "njit" in ast.unparse(d)]
    return found


@pytest.mark.parametrize("package", ["registration", "poro"])
def test_no_kernel_may_reorder_its_sums(package: str) -> None:
    assert len(compiled(package)) > 5
    assert [f"{file.name}: {node.name}" for file, node, by in compiled(package) if "fastmath" in by] == []


@pytest.mark.parametrize("package", ["registration", "poro"])
def test_no_parallel_loop_adds_up_across_threads(package: str) -> None:
    """A name that a prange adds to, and that no statement inside the loop sets first, is a sum over its threads."""
    sums = []
    for file, kernel, _ in compiled(package):
        for loop in ast.walk(kernel):
            if not (isinstance(loop, ast.For) and "prange" in ast.unparse(loop.iter)):
                continue
            inside = [node for statement in loop.body for node in ast.walk(statement)]
            targets = [t for node in inside if isinstance(node, ast.Assign) for t in node.targets]
            own = {name.id for t in targets for name in ast.walk(t) if isinstance(name, ast.Name)}
            added = {n.target.id for n in inside if isinstance(n, ast.AugAssign) and isinstance(n.target, ast.Name)}
            sums += [f"{file.name}: {kernel.name} adds to {name}" for name in added - own]
    assert sums == []


def test_the_local_correlation_is_the_mean_over_the_samples() -> None:
    rng = np.random.default_rng(0)
    shape = (9, 8, 7)
    fixed = rng.normal(0, 100, shape).astype(np.float32).ravel()
    metric = LocalNcc(fixed, np.arange(fixed.size), shape, 2, 1e-3)
    ones = np.ones_like(fixed)
    assert metric.evaluate(fixed.copy(), ones).value == pytest.approx(0, abs=1e-3)
    assert metric.evaluate(-fixed, ones).value == pytest.approx(2, abs=1e-3)
