"""Phantoms share nothing with what is judged by them."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import phantoms


def test_phantoms_import_nothing_that_is_judged_by_them() -> None:
    named = set()
    for file in Path(phantoms.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                named.add(node.module)
            elif isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
    ours = {name for name in named if name.split(".")[0] in ("poro", "registration", "vatsloc")}
    assert ours == set()


def test_making_a_phantom_loads_nothing_that_is_judged_by_it() -> None:
    script = (
        "import sys, phantoms.case, phantoms.twin, phantoms.breathing, phantoms.projection;"
        "print(*sorted(m for m in sys.modules if m.split('.')[0] in ('poro', 'registration', 'vatsloc')))"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert said == []
