"""Runs GetFEM beside us: the same mesh, loads and wall go out in a file, displacements and seconds come back."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poro.arrays import Array
from poro.collapse import PoroSystem, Theta
from poro.fem.tissue import GRAVITY_KPA_PER_MM
from vatsloc.errors import VatslocError
from vatsloc.study.bench.poro_lung import WALL

_WORKER = Path(__file__).with_name("getfem_worker.py")
_AUGMENTATION = 0.1  # kPa/mm, about the tissue's stiffness over an element; any value near it converges


@dataclass(frozen=True)
class GetfemAnswer:
    """GetFEM's solutions of k cases. free, contact: (k, n, 3) mm without and with wall; free_s, contact_s: (k,) CPU
    seconds from the mesh with its fields on; mesh_s: those to read the mesh; steps: (k,) Newton steps with wall.
    """

    free: Array
    contact: Array
    free_s: Array
    contact_s: Array
    mesh_s: float
    steps: Array


def getfem_python() -> str | None:
    """A Python that can import GetFEM (Debian's python3-getfem serves the system's), or None."""
    for candidate in (sys.executable, "/usr/bin/python3", shutil.which("python3")):
        if candidate and Path(candidate).exists():
            check = subprocess.run([candidate, "-c", "import getfem"], capture_output=True, check=False)
            if check.returncode == 0:
                return candidate
    return None


def run_getfem(python: str, system: PoroSystem, thetas: list[Theta]) -> GetfemAnswer:
    """Solve a system in front of `WALL` at several parameter values by GetFEM; raises VatslocError when it fails."""
    mesh, tissue, n = system.mesh, system.tissue, len(system.mesh.points)
    offset, moving, imposed = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3))
    offset[system.contact_nodes] = system.wall.offset
    moving[system.contact_nodes] = system.wall.moving[:, None] * system.wall.axis
    imposed[system.hilum] = system.hilum_displacement
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "problem.npz", Path(folder) / "answer.npz"
        np.savez(
            source,
            points=mesh.points,
            tets=mesh.tets,
            hilum=system.hilum,
            imposed=imposed,
            offset=offset,
            moving=moving,
            wall=WALL,
            mobility=tissue.mobility,
            pleural=tissue.pleural_kpa,
            lame=tissue.lame_kpa,
            shear=tissue.shear_kpa,
            biot=tissue.biot,
            weight=system.gravity * GRAVITY_KPA_PER_MM,
            augmentation=_AUGMENTATION,
            cases=np.array([[t.kappa_b, tissue.density(t.phi), t.d_diaph_mm] for t in thetas]),
        )
        # Another installation's packages on the path would break the compiled module of the system's Python.
        clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
        run = subprocess.run(
            [python, str(_WORKER), str(source), str(target)], capture_output=True, text=True, check=False, env=clean
        )
        if run.returncode:
            last = run.stderr.strip().splitlines()[-1:]
            raise VatslocError(f"GetFEM failed: {' '.join(last)}; run the benchmark without it or report the case.")
        with np.load(target) as answer:
            parts = {name: answer[name] for name in ("free", "contact", "free_s", "contact_s", "steps")}
            return GetfemAnswer(mesh_s=float(answer["mesh_s"]), **parts)
