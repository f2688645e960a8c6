"""Phantoms share nothing with what is judged by them but the containers of voxels."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import phantoms


def test_phantoms_name_no_solver_and_no_registration() -> None:
    named = set()
    for file in Path(phantoms.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                named.add(node.module)
            elif isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
    ours = {name for name in named if name.split(".")[0] in ("poro", "registration", "vatsloc")}
    assert ours == {"registration.volume"}


def test_making_a_phantom_loads_no_solver_and_no_registration() -> None:
    script = (
        "import sys, phantoms.case, phantoms.twin, phantoms.breathing, phantoms.projection;"
        "print(*sorted(m for m in sys.modules if m.split('.')[0] in ('poro', 'registration', 'vatsloc')))"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert said == ["registration", "registration.volume"]
