"""Phantoms share nothing with what is judged by them."""

from __future__ import annotations

import subprocess
import sys


def test_making_a_phantom_loads_nothing_that_is_judged_by_it() -> None:
    script = (
        "import sys, phantoms.case, phantoms.twin, phantoms.breathing, phantoms.projection;"
        "print(*sorted(m for m in sys.modules if m.split('.')[0] in ('poro', 'registration', 'vatsloc')))"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split()
    assert said == []
