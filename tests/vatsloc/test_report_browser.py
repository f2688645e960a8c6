"""The page in a browser: nothing asked of the network, no error, every viewer draws, sliders move the pictures.

A probe, appended to a copy of the page, reads pixels after the page's own scripts and leaves numbers in the document.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from registration.maps.rigid import RigidTransform
from registration.volume import Volume
from tests.vatsloc.browser import CHROMIUM, asked_by_the_page, visit
from vatsloc.formats.meshes import Surface
from vatsloc.report.data import Comparison, Landmark, Motion, Nodule, ReportData
from vatsloc.report.render import write_report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")

AFFINE = np.array([[2.0, 0, 0, -60], [0, 2, 0, -60], [0, 0, 2, -40], [0, 0, 0, 1]])
CORNERS = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]])
NODULE = np.array([5.0, -8, 4])

PROBE = """<script>
setTimeout(() => {
  const found = {};
  const count = (canvas, test) => {
    const rgba = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
    let n = 0;
    for (let p = 0; p < rgba.length; p += 4) n += test(rgba[p], rgba[p + 1], rgba[p + 2], rgba[p + 3]);
    return n / (rgba.length / 4);
  };
  const space = document.getElementById("space");
  found.lung = count(space, (r, g, b) => r > 90 && r > g + 20 && g > b + 20);
  found.nodule = count(space, (r, g, b) => r > 150 && g > 140 && b < 110);
  found.before = count(space, (r, g, b) => b > 120 && b > r + 50);
  for (const name of ["axial", "coronal", "sagittal"]) {
    const figure = document.getElementById("stack-" + name), lines = figure.querySelector("canvas.lines");
    found[name] = count(lines, (r, g, b, a) => a > 128 && r > 200 && g > 120 && g < 190 && b < 60);
    found[name + "_blend"] = Number(figure.querySelector(".moving").style.opacity);
    const [seen, pen] = [figure.querySelector(".fixed"), document.createElement("canvas").getContext("2d")];
    pen.canvas.width = seen.naturalWidth; pen.canvas.height = seen.naturalHeight; pen.drawImage(seen, 0, 0);
    found[name + "_bright"] = count(pen.canvas, (r) => r > 100);
  }
  found.wide = document.documentElement.scrollWidth;
  const result = document.createElement("pre");
  result.id = "found"; result.textContent = JSON.stringify(found);
  document.body.append(result);
}, 200);
</script>"""


def image(inside_hu: float) -> Volume:
    hu = np.full((60, 60, 40), -1000, dtype=np.float32)
    hu[20:40, 20:40, 10:30] = inside_hu
    return Volume(hu, AFFINE)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    phase = Comparison(
        title="Phase 2",
        fixed_name="deflated CBCT",
        fixed=image(0),
        before_name="inflated CBCT",
        before=image(0),
        before_from_fixed=RigidTransform.identity(),
        after_name="warped CT",
        after=image(-400),
        nodule=Nodule(NODULE, np.diag([8.0, 6, 5])),
    )
    cage = Surface(40 * CORNERS, TRIANGLES)
    motion = Motion(TRIANGLES, 40 * CORNERS, 20 * CORNERS, cage, NODULE + np.array([20.0, 0, 0]))
    run = {"seconds": {"fit": 2.0, "total": 3.0}, "gates": {}, "warnings": [], "side": "right"}
    marks = (Landmark("apex", np.array([20.0, 20, 20]), 30.0, True),)
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(
        path, ReportData("boxes", run, phase.nodule, (phase,), (), 9.0, np.array([20.0, -8, 4]), marks, motion)
    )
    return path


def probed(page: Path, folder: Path, fragment: str = "", size: str = "1280,800") -> dict[str, float]:
    """What the probe finds on the page."""
    copy = folder / "probed.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", PROBE + "</body>"), encoding="utf-8")
    document, logged, _ = visit(copy, folder, fragment, size)
    found = re.search(r'<pre id="found">(.*?)</pre>', document, re.DOTALL)
    assert found is not None, logged
    measured: dict[str, float] = json.loads(found[1])
    return measured


@pytest.fixture(scope="module")
def seen(page: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, float]]:
    views = {"plain": "", "inflated": "#deform=0", "blended": "#blend=60", "turned": "#turn=90"}
    views["nonsense"] = "#deform=x&blend=900"
    return {name: probed(page, tmp_path_factory.mktemp(name), fragment) for name, fragment in views.items()}


def test_page_loads_without_an_error_and_asks_nothing_of_the_network(page: Path, tmp_path: Path) -> None:
    _, logged, network = visit(page, tmp_path)
    assert "CONSOLE" not in logged
    assert not asked_by_the_page(network)


def test_a_request_would_have_been_refused_and_without_the_policy_seen(page: Path, tmp_path: Path) -> None:
    text = page.read_text(encoding="utf-8")
    text = text.replace("</body>", '<img alt="x" src="http://127.0.0.1:9/x.png"></body>')
    spoiled = tmp_path / "spoiled.html"
    spoiled.write_text(text, encoding="utf-8")
    _, logged, network = visit(spoiled, tmp_path)
    assert "Content Security Policy" in logged
    assert not asked_by_the_page(network)
    spoiled.write_text(text.replace("Content-Security-Policy", "none"), encoding="utf-8")
    assert asked_by_the_page(visit(spoiled, tmp_path)[2])


def test_every_viewer_draws(seen: dict[str, dict[str, float]]) -> None:
    plain = seen["plain"]
    assert plain["lung"] > 0.02
    assert plain["nodule"] > 0.001
    assert plain["before"] > 0.0003
    for name in ("axial", "coronal", "sagittal"):
        assert 0.001 < plain[name] < 0.05
        assert 0.05 < plain[f"{name}_bright"] < 0.35


def test_deformation_moves_the_lung_in_space_and_in_the_slices(seen: dict[str, dict[str, float]]) -> None:
    # Twice the edge: four times the area in space, and twice the line in a slice, where it leaves the picture in part.
    assert seen["inflated"]["lung"] > 3 * seen["plain"]["lung"]
    assert seen["inflated"]["axial"] > 1.5 * seen["plain"]["axial"]


def test_blend_shows_the_warped_image(seen: dict[str, dict[str, float]]) -> None:
    assert [seen[view]["axial_blend"] for view in ("plain", "blended", "nonsense")] == [0, 0.6, 1]


def test_turning_shows_another_side_and_nonsense_is_ignored(seen: dict[str, dict[str, float]]) -> None:
    assert seen["turned"]["lung"] != seen["plain"]["lung"]
    assert seen["nonsense"]["lung"] == seen["plain"]["lung"]


@pytest.mark.parametrize("size", ["1280,800", "820,1180"])
def test_page_fits_its_window(page: Path, tmp_path: Path, size: str) -> None:
    assert probed(page, tmp_path, size=size)["wide"] <= int(size.split(",")[0])
