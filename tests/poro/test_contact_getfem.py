"""Two bodies pressed together, beside GetFEM on the same meshes; skipped where no Python can import GetFEM.

The two discretize contact otherwise, so that they agree as far as the meshes resolve it, not to rounding.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from blocks import Spheres

from poro.fem import Tissue, solid
from vatsloc.study.bench.getfem_peer import getfem_python

WORKER = Path(__file__).with_name("getfem_contact.py")
SPHERES = Spheres(Tissue(), (600.0, 1200.0), 8.0)


def test_getfem_presses_two_spheres_alike(tmp_path: Path) -> None:
    """Force and displacements, these beside what contact adds to the motion, to 2 %."""
    python = getfem_python()
    if python is None:
        pytest.skip("no Python here can import GetFEM")
    pair, held, motion = SPHERES.pair((8, 7), (2.0, 2.5))
    body = solid(pair.mesh, SPHERES.tissue, held)
    free = body.solve(np.zeros_like(pair.mesh.points), motion)
    state, u = pair.solve(body, free)
    imposed, touching = np.zeros_like(pair.mesh.points), np.zeros(len(pair.lower), bool)
    imposed[held], touching[pair.nodes] = motion, True
    first, problem = int(pair.lower.sum()), {}
    for number, mine in enumerate((pair.lower, ~pair.lower)):
        start = number * first
        problem |= {
            f"points{number}": pair.mesh.points[mine],
            f"tets{number}": pair.mesh.tets[mine[pair.mesh.tets[:, 0]]] - start,
            f"held{number}": held[mine[held]] - start,
            f"touching{number}": np.flatnonzero(touching[mine]),
            f"imposed{number}": imposed[mine],
        }
    moduli = {"lame": SPHERES.tissue.lame_kpa, "shear": SPHERES.tissue.shear_kpa}
    np.savez(tmp_path / "problem.npz", augmentation=0.1, reach=5.0, **moduli, **problem)
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    files = [str(tmp_path / name) for name in ("problem.npz", "answer.npz")]
    subprocess.run([python, str(WORKER), *files], check=True, env=clean, capture_output=True)
    with np.load(tmp_path / "answer.npz") as answer:
        theirs, force = answer["u"], float(answer["force"])
    assert state.force.sum() == pytest.approx(force, rel=0.02)
    assert np.linalg.norm(u - theirs) < 0.02 * np.linalg.norm(u - free)
    assert np.abs(u - theirs).max() < 0.02 * SPHERES.approach
