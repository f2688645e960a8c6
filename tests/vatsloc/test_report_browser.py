"""The page in a browser: nothing asked of the network, no error, every viewer draws, sliders move the pictures.

A probe, appended to a copy of the page, reads pixels a second after the page's own scripts, which paint coarsely until
nothing has moved for a tenth of one, and leaves numbers in the document.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
import pytest
from pypdf import PdfReader

from registration.maps.rigid import RigidTransform
from registration.volume import Volume
from tests.vatsloc.browser import CHROMIUM, asked_by_the_page, printed, visit
from vatsloc.formats.meshes import Surface
from vatsloc.report.data import Comparison, Landmark, Motion, Nodule, ReportData
from vatsloc.report.render import render

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
  const wide = space.width, high = space.height, rim = [];
  const rgba = space.getContext("2d").getImageData(0, 0, wide, high).data;
  const is = (x, y) => {
    const [r, g, b] = rgba.subarray(4 * (y * wide + x));
    return r > 40 && r > g + 10 && g > b + 8;
  };
  let n = 0, mx = 0, my = 0;
  for (let y = 0; y < high; y++) for (let x = 0; x < wide; x++) if (is(x, y)) { n++; mx += x; my += y; }
  for (let d = 0; d < 2 * Math.PI; d += Math.PI / 180) {
    let far = 0;
    for (let r = 1; r < high / 2; r += 0.25) {
      const x = Math.round(mx / n + r * Math.cos(d)), y = Math.round(my / n + r * Math.sin(d));
      if (x >= 0 && y >= 0 && x < wide && y < high && is(x, y)) far = r;
    }
    rim.push(far);
  }
  found.rim = rim;
  found.wide = document.documentElement.scrollWidth;
  const result = document.createElement("pre");
  result.id = "found"; result.textContent = JSON.stringify(found);
  document.body.append(result);
}, 1000);
</script>"""


def image(inside_hu: float) -> Volume:
    hu = np.full((60, 60, 40), -1000, dtype=np.float32)
    hu[20:40, 20:40, 10:30] = inside_hu
    return Volume(hu, AFFINE)


def data(motion: Motion, marks: tuple[Landmark, ...] = (), **run: Any) -> ReportData:
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
    record = {"seconds": {"fit": 2.0, "total": 3.0}, "gates": {}, "warnings": [], "side": "right"} | run
    foot = np.array([20.0, -8, 4])
    return ReportData("boxes", record, phase.nodule, (phase,), (), 9.0, foot, marks, motion)


BOXES = Motion(TRIANGLES, 40 * CORNERS, 20 * CORNERS, Surface(40 * CORNERS, TRIANGLES), NODULE + np.array([20.0, 0, 0]))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    marks = (Landmark("apex", np.array([20.0, 20, 20]), 30.0, True),)
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(render(data(BOXES, marks)), encoding="utf-8")
    return path


def probed(page: Path, folder: Path, fragment: str = "", size: str = "1280,800") -> dict[str, Any]:
    """What the probe finds on the page."""
    copy = folder / "probed.html"
    copy.write_text(page.read_text(encoding="utf-8").replace("</body>", PROBE + "</body>"), encoding="utf-8")
    document, logged, _ = visit(copy, folder, fragment, size)
    found = re.search(r'<pre id="found">(.*?)</pre>', document, re.DOTALL)
    assert found is not None, logged
    measured: dict[str, Any] = json.loads(found[1])
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


SAYS = "Independent keypoints show the CT's structures elsewhere in the inflated CBCT than the result says."
"""The longest sentence of a gate."""


def ball_page(folder: Path) -> Path:
    """A page whose lung is a ball of 30 mm of 128 triangles, an octahedron quartered twice."""
    corners = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    flat = corners[faces]
    for _ in range(2):
        a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
        ab, bc, ca = a + b, b + c, c + a
        quarters = [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        flat = np.concatenate(quarters)
        flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    points, triangles = np.unique(flat.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    motion = Motion(triangles.reshape(-1, 3), 30 * points, 30 * points, Surface(40 * CORNERS, TRIANGLES), NODULE)
    folder.mkdir()
    (folder / "report.html").write_text(render(data(motion)), encoding="utf-8")
    return folder / "report.html"


def test_the_rim_of_the_lung_is_smooth_although_its_mesh_is_coarse(tmp_path: Path) -> None:
    page = ball_page(tmp_path / "page")

    def sharpest_corner() -> float:
        """How much the rim turns within 6 degrees beyond a circle's turn: the largest second difference of its radius,
        as a share of it, each value the mean over 5 degrees, since a pixel is 0.5 % of the radius."""
        rim = np.array(probed(page, tmp_path)["rim"])
        radius = np.mean([np.roll(rim / np.median(rim), k) for k in range(-2, 3)], axis=0)
        return float(np.abs(np.roll(radius, 6) - 2 * radius + np.roll(radius, -6)).max())

    smooth = sharpest_corner()
    text = page.read_text(encoding="utf-8")
    assert text.count("const STEPS = 2") == 1
    page.write_text(text.replace("const STEPS = 2", "const STEPS = 0"), encoding="utf-8")
    coarse = sharpest_corner()
    assert smooth < 0.01  # 0.007 where it was made
    assert coarse > 0.03  # the mesh's own corners, 0.035


@pytest.mark.parametrize("hard", [False, True])
def test_the_report_prints_on_two_a4_pages_that_say_what_matters(hard: bool, tmp_path: Path) -> None:
    """hard: as much to say as a run ever has, all gates failed and many long warnings."""
    names = ["overlap", "check", *(f"gate_{n}" for n in range(19))]
    gates = {name: {"ok": not hard, "value": 0.5, "limit": 0.4, "says": SAYS} for name in names}
    warnings = [f"Warning {n}: " + "what the reader of a result has to know, " * 6 for n in range(30)] if hard else []
    page = render(data(BOXES, gates=gates, warnings=warnings))
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    pdf = PdfReader(printed(tmp_path / "report.html", tmp_path))
    assert len(pdf.pages) == 2
    for sheet in pdf.pages:
        assert [float(x) for x in sheet.mediabox[2:]] == pytest.approx([595.3, 841.9], abs=1.0)
    first, second = (" ".join(normalize("NFKC", sheet.extract_text()).split()) for sheet in pdf.pages)
    trust = "Do not trust it 0 of 21 gates passed" if hard else "Trust it 21 of 21 gates passed"
    where = "-5.0, 8.0, 4.0 mm, LPS, in the deflated CBCT"
    for words in (trust, where, "± 8.0 mm holds it with 95 %, widest direction", "9.0 mm below the collapsed lung's"):
        assert words in first
    assert ("and 26 more, in report.html and run.json" in first) == hard
    assert "gate 18" in second
    assert "A research tool, not a medical device." in second
    assert len(pdf.pages[0].images) >= 1  # the lung in three dimensions
    assert len(pdf.pages[1].images) >= 3  # the three planes


def test_a_glance_tells_trust_place_sureness_and_depth(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    tiles = re.findall(r'<div class="tile ?(\w*)"><b>(.*?)</b><strong>(.*?)</strong><small>(.*?)</small></div>', text)
    assert tiles == [
        ("ok", "trust", "Trust it", "0 of 0 gates passed"),
        ("", "where", "-5.0, 8.0, 4.0", "mm, LPS, in the deflated CBCT"),
        ("", "how sure", "± 8.0 mm", "holds it with 95 %, widest direction"),
        ("", "how deep", "9.0 mm", "below the collapsed lung&#39;s surface"),
    ]
