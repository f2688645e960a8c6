"""The study of the fit: what it counts as a silent failure, and its figures on a target that the model itself made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from poro.collapse import PoroSystem, Theta, assemble, solve
from poro.fem import Tissue
from poro.fit import Target
from poro.fit.identifiability import THETA_NAMES
from poro.mesh import stuff_level_set
from vatsloc.imaging.surface import Border, SurfacePoints
from vatsloc.study.stability.fit import DISTURBANCES, identifiability, page, random_starts
from vatsloc.workflow.observe import Observed
from vatsloc.workflow.settings import Settings

THETA = Theta(2e-8, 0.7)


@pytest.fixture(scope="module")
def own() -> tuple[PoroSystem, Target]:
    """An ellipsoid, and its own surface at THETA."""
    r = np.array([45.0, 55.0, 70.0])
    mesh = stuff_level_set(lambda p: (1 - np.linalg.norm(p / r, axis=1)) * r.min(), -r - 5, r + 5, 18.0)
    hilum = np.flatnonzero(np.linalg.norm(mesh.points - [-45, 0, 0], axis=1) < 25)
    system = assemble(mesh, Tissue(), np.array([1.0, 0, 0]), hilum, np.zeros((len(hilum), 3)))
    boundary = mesh.boundary
    moved = boundary.moved(boundary.points + solve(system, THETA).u[boundary.nodes])
    return system, Target(moved.points, moved.node_normals, np.ones(len(moved.points)))


def test_random_starts_find_the_target_that_the_model_made(own: tuple[PoroSystem, Target]) -> None:
    found = random_starts(*own, Settings(), count=6)
    assert found["starts"] == 6
    assert 1 <= found["at the best cost"] <= 6
    assert found["farthest apart there, mm"] < 1.0
    assert found["elsewhere, said to be settled"] <= 6 - found["at the best cost"]
    assert found["default start over the best cost, %"] < 2.0


def test_parameters_are_reported_with_what_holds_them(own: tuple[PoroSystem, Target]) -> None:
    rows = identifiability(*own, Settings())
    assert [row["parameter"] for row in rows] == list(THETA_NAMES)
    assert rows[0]["estimate"] == pytest.approx(np.log10(THETA.kappa_b), abs=0.3)
    assert rows[1]["estimate"] == pytest.approx(THETA.phi, abs=0.1)
    for row in rows:
        assert row["sigma"] > 0
        assert -1 <= row["strongest correlation"] <= 1
    assert rows[0]["cost rise above, %"] > 10
    informed = [row["singular value"] for row in rows]
    assert informed == sorted(informed, reverse=True)


def _scene() -> Any:
    """As much of a scene as a disturbance of the surface or of gravity touches."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    surface = SurfacePoints(60 * normals, normals, np.ones(400), np.full(400, Border.AIR, dtype=np.int8))
    nothing: Any = None
    motion = SimpleNamespace(displacement=np.zeros((5, 3)))
    observed = Observed(nothing, nothing, surface, nothing, nothing, nothing, nothing, nothing)
    return surface, replace(observed, motion=motion)  # type: ignore[arg-type]


def test_disturbances_do_what_they_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    from vatsloc.study.stability.fit import Scene

    surface, observed = _scene()
    nothing: Any = None
    scene = Scene(nothing, nothing, nothing, nothing, nothing, observed)
    rng = np.random.default_rng(0)
    noisy = DISTURBANCES["surface noise 5 mm"](scene, rng).observed.surface
    off = np.einsum("nd,nd->n", noisy.points - surface.points, surface.normals)
    np.testing.assert_allclose(noisy.points - surface.points, off[:, None] * surface.normals, atol=1e-9)
    assert off.std() == pytest.approx(5.0, rel=0.1)
    assert len(DISTURBANCES["surface 80 % missing"](scene, rng).observed.surface) == 80


def test_silent_failures_are_counted() -> None:
    rows = [
        {"case": "a", "disturbed": "x", "landmarks_mm": 12.0, "nodule_mm": 1.0, "flagged": "", "silent": True},
        {"case": "a", "disturbed": "y", "landmarks_mm": 12.0, "nodule_mm": 1.0, "flagged": "surface", "silent": False},
    ]
    assert "**1 of 2**" in page({"disturbed": rows, "starts": [], "identifiability": []})


def test_the_picture_shows_every_run_that_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.axes import Axes

    from vatsloc.study.stability.fit_draw import draw_disturbed

    drawn: list[tuple[list[float], str]] = []
    plain = Axes.scatter

    def noted(self: Axes, x: list[float], y: list[float], **style: Any) -> Any:
        drawn.append((list(x), style["facecolors"]))
        return plain(self, x, y, **style)

    monkeypatch.setattr(Axes, "scatter", noted)
    rows = [
        {"case": "a", "disturbed": "x", "landmarks_mm": 2.0, "flagged": ""},
        {"case": "a", "disturbed": "y", "landmarks_mm": 12.0, "flagged": "surface"},
        {"case": "a", "disturbed": "z", "landmarks_mm": "", "flagged": "InputRefused"},
    ]
    draw_disturbed(rows, 10.0, tmp_path / "disturbed.png")
    assert drawn == [([2.0], "C0"), ([12.0], "none")]
    assert (tmp_path / "disturbed.png").read_bytes()[:4] == b"\x89PNG"


def test_a_case_without_landmarks_is_refused(tmp_path: Path) -> None:
    from vatsloc.errors import CaseError
    from vatsloc.study.stability.fit import stability_fit

    with pytest.raises(CaseError):
        stability_fit([tmp_path], tmp_path / "out", Settings())
