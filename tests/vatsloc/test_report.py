"""The page: its answer, its verdict, its pictures' pixels, and that it needs nothing from outside."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from registration.maps.rigid import RigidTransform
from registration.volume import Mask, Volume
from vatsloc.report.charts import LABEL, bars, box_plot
from vatsloc.report.data import LUNG, NODULE, Comparison, Nodule, Outline, Picture, ReportData, TreSection
from vatsloc.report.paint import bgr
from vatsloc.report.render import MEASURE_NAMES, judge, render, with_scores

CENTRE, RIGHT = np.array([12.0, -8.0, 5.0]), np.array([1.0, 0, 0])
AFFINE = np.array([[2.0, 0, 0, -60], [0, 2, 0, -60], [0, 0, 2, -40], [0, 0, 0, 1]])
VOID = {"meta", "link", "img", "input", "br"}
PASSED, FAILED = {"ok": True, "value": 0.9, "limit": 0.6}, {"ok": False, "value": 7.0, "limit": 5.0, "says": "Too far."}


def image(bright_at=None):
    """Soft tissue; one voxel's neighbourhood at bright_at is bone."""
    hu = np.full((60, 60, 40), -400, dtype=np.float32)
    if bright_at is not None:
        i, j, k = np.rint((bright_at - AFFINE[:3, 3]) / 2).astype(int)
        hu[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2] = 1000
    return Volume(hu, AFFINE)


def run(**changes):
    record = {
        "status": "converged",
        "theta": {"kappa_b": 1.5e-8, "phi": 0.81, "d_diaph_mm": 3.2},
        "seconds": {"total": 71.2, "fit": 8.8, "registration": 28.4},
        "peak_mb": 1900.0,
        "skipped": {"extrapolation": "the scanner sees the whole lung"},
        "gates": {"spine_ncc": PASSED},
        "warnings": [],
        "input_sha256": {"ct": "0123abcd"},
    }
    return record | changes


def report():
    inside = np.zeros((60, 60, 40), dtype=bool)
    inside[10:50, 10:50, 5:35] = True
    outline = Outline("lung mask", LUNG, Mask(inside, AFFINE))
    phase = Comparison(
        title="Phase 2",
        fixed_name="deflated CBCT",
        fixed=image(CENTRE),
        before_name="inflated CBCT",
        before=image(),
        before_from_fixed=RigidTransform.identity(),
        after_name="warped CT",
        after=image(CENTRE + 20 * RIGHT),
        nodule=Nodule(CENTRE, np.diag([8.0, 6, 5])),
        outlines=(outline,),
    )
    picture = Picture("Lung", "The mask.", image(), CENTRE, (outline,))
    return ReportData("a case", run(), phase.nodule, (phase,), (picture,), 11.3, CENTRE + 10 * RIGHT)


def words_alone(**changes):
    return render(ReportData("a case", run(**changes), Nodule(CENTRE), ()))


@pytest.fixture(scope="module")
def page():
    return render(report())


def viewer(page):
    text = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL)[1]
    return {stack["name"]: stack for stack in json.loads(text)["stacks"]}


def pixels(uri):
    data = np.frombuffer(base64.b64decode(uri.partition("base64,")[2]), dtype=np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


def still(page, beginning_of_alt):
    return pixels(re.search(rf'<img src="([^"]*)" alt="{beginning_of_alt}', page)[1])


class Balanced(HTMLParser):
    """Fails on an element that is not closed by its own end tag."""

    def __init__(self):
        super().__init__()
        self.open, self.ids = [], []

    def handle_starttag(self, tag, attrs):
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_answer_stands_in_both_frames(page):
    assert re.search(r'id="nodule-ras">12\.0, -8\.0, 5\.0<', page)
    assert re.search(r'id="nodule-lps">-12\.0, 8\.0, 5\.0<', page)
    assert "8.0 × 6.0 × 5.0 mm" in page
    assert "11.3 mm" in page
    assert "-22.0, 8.0, 5.0 mm, LPS" in page


def test_page_needs_nothing_from_outside(page):
    assert "http:" not in page
    assert "https:" not in page
    references = re.findall(r"""(?:src|href)\s*=\s*["']([^"']*)|url\(([^)]*)""", page)
    assert {(a or b)[:5] for a, b in references} == {"data:"}
    assert "@import" not in page


def test_page_is_well_formed_and_every_picture_is_described(page):
    parser = Balanced()
    parser.feed(page)
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    images = re.findall(r"<img [^>]*>", page)
    assert len(images) == 3 * 2 + 2 * 3 + 3
    assert all(re.search(r'alt="[^"]{10,}"', tag) for tag in images)
    sliders = re.findall(r'<input type="range"[^>]*>', page)
    assert len(sliders) == 4
    assert all("aria-label=" in tag for tag in sliders)


def test_record_of_the_run_is_there(page):
    for words in ("71.2", "28.4 s", "1900 MB", "1.5e-08", "0.81", "the scanner sees the whole lung", "0123abcd"):
        assert words in page


def test_what_was_chosen_is_told_with_its_reason():
    refinements = [
        {"name": "regional", "before_mm": 3.214, "after_mm": 2.5, "kept": True},
        {"name": "elastic", "before_mm": 2.5, "after_mm": None, "kept": False},
    ]
    strain = {"part": "finite strain", "kept": False, "why": "0.02 % of the elements are out of range"}
    skipped = {"finite strain": strain["why"], "keypoints": "switched off"}
    page = words_alone(
        choices=[strain, strain | {"part": "extrapolation", "kept": True, "why": "unseen"}],
        skipped=skipped,
        residuals={"model_selection": refinements},
    )
    assert "<dt>finite strain</dt><dd>left out: 0.02 % of the elements are out of range</dd>" in page
    assert "<summary>2 parts weighed, 1 left out as needless</summary>" in page
    assert page.count("0.02 % of the elements") == 1
    assert "<dt>left out: keypoints</dt><dd>switched off</dd>" in page
    assert (
        "<dt>kept: regional</dt><dd>median misfit at held-out keypoints 3.21 mm without it, 2.5 mm with it</dd>" in page
    )
    assert "<dt>not kept: elastic</dt>" in page
    assert "kept:" not in words_alone()


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({}, "ok", "Every quality gate passed, no warnings."),
        ({"warnings": ["Look here."]}, "warn", "1 warning to read first"),
        (
            {"gates": {"surface_rms_mm": FAILED, "x": PASSED}, "warnings": ["w"]},
            "fail",
            "1 of 2 quality gates failed (surface rms",
        ),
    ],
)
def test_banner_follows_gates_and_warnings(changes, level, words):
    assert judge(run(**changes))[0] == level
    page = words_alone(**changes)
    banner = re.search(r'<div class="banner (\w+)" role="status" id="verdict">(.*?)</div>', page)
    assert banner[1] == level
    assert words in banner[2]
    for gate in run(**changes)["gates"].values():
        assert gate["ok"] or gate["says"] in page


@pytest.mark.parametrize(
    ("lengths", "words"), [([2, 6.25, 4], "6.2 × 4.0 × 2.0 mm"), ([None] * 3, "not estimated"), (None, "not estimated")]
)
def test_ellipsoid_without_directions_still_has_a_size(lengths, words):
    assert words in words_alone(nodule_ellipsoid95_mm=lengths)


def test_words_of_the_run_cannot_become_markup():
    page = words_alone(warnings=["a </script><b>bold</b> claim"])
    assert "<b>bold" not in page
    assert "a &lt;/script&gt;&lt;b&gt;bold" in page


@pytest.mark.parametrize("name", ["axial", "coronal", "sagittal"])
def test_viewer_shows_the_fixed_image_below_and_the_warped_one_above(page, name):
    stack = viewer(page)[name]
    column, row = (round(float(v)) for v in pixel_of(stack, CENTRE))
    fixed, moving = (pixels(stack[kind][stack["start"]]) for kind in ("fixed", "moving"))
    assert fixed[row, column] > 240
    assert abs(int(moving[row, column]) - 255 * 600 / 1250) < 15


def test_blend_is_magenta_where_only_the_fixed_image_is_bright_and_carries_the_mark(page):
    before = still(page, "Phase 2. Before: inflated CBCT, rigid pose alone. axial")
    after = still(page, "Phase 2. After: warped CT. axial")
    mm = 118.0 / (before.shape[1] - 1)
    column, row = round((58 - CENTRE[0]) / mm), round((58 - CENTRE[1]) / mm)
    for picture in (before, after):
        assert_allclose(picture[row, column], bgr(NODULE), atol=60)
    aside = round(1.6 / mm)
    blue, green, red = before[row - aside, column - aside].astype(int)
    assert min(blue, red) > green + 60
    # The warped CT's bright spot lies 20 mm to the patient's right, so to the left on the page, and is green.
    blue, green, red = after[row, round((58 - CENTRE[0] - 20) / mm)].astype(int)
    assert green > max(blue, red) + 60


def pixel_of(stack, point):
    away = np.asarray(point) - stack["origin"]
    spacing = np.linalg.norm(stack["right"])
    return np.array([away @ stack["right"], away @ stack["down"]]) / spacing**2


def scores(**changes):
    one = {"mean": 3.21, "sd": 1.0, "median": 3.0, "p95": 5.0, "max": 6.0, "n": 4}
    summary = dict.fromkeys(MEASURE_NAMES, one)
    depth = {"chain": [{"from_mm": 0.0, "to_mm": 10.0, **one}, {"from_mm": 10.0, "to_mm": None, **one}]}
    summary |= {"nodule_inflated_mm": None, "nodule_deflated_mm": 2.7, "nodule_in_ellipsoid95": False}
    summary |= {"in_radius95": {"landmarks": {"share": 0.75, "n": 40, "median_mm": 4.25}}}
    summary |= {
        "wilcoxon_p": {"chain": 1e-6},
        "by_depth": depth,
        "dense": None,
        "warnings": ["Two <landmarks> left out."],
    }
    return TreSection(summary | changes, {m: np.array([1.0, 2, 4, np.nan]) for m in MEASURE_NAMES})


def test_scores_are_written_into_the_page_and_over_older_ones(page):
    filled = with_scores(page, scores())
    parser = Balanced()
    parser.feed(filled)
    assert parser.open == []
    assert filled.count("3.21") == 6 + 2
    assert "2.70 mm off, outside the 95 % ellipsoid" in filled
    assert "30 of 40 (median radius 4.2 mm)" in filled
    assert "&lt; 0.001" in filled
    assert "Two &lt;landmarks&gt;" in filled
    again = with_scores(filled, scores(nodule_deflated_mm=9.87))
    assert "9.87 mm off" in again
    assert "2.70 mm off" not in again
    assert with_scores(again, scores()) == filled
    assert 'id="tissue"' not in filled
    shallow = {"from_mm": 0.0, "to_mm": 5.0, "n": 77, "phase1": {"mean": 1.11, "p95": 2.22}}
    shallow |= {"chain": {"mean": 3.33, "p95": 4.44}, "share_in_radius95": 0.956}
    nothing = {"from_mm": 30.0, "to_mm": None, "n": 0, "phase1": None, "chain": None, "share_in_radius95": None}
    tissue = with_scores(page, scores(dense={"by_depth": [shallow, nothing]}))
    row = tissue.partition('id="tissue"')[2].partition("<tbody>")[2].partition("</tbody>")[0]
    assert re.findall(r">([^<>\n]+)<", row) == ["0 to 5", "1.11", "2.22", "3.33", "4.44", "96 %", "77"]
    untold = {"landmarks": {"share": None, "n": 0, "median_mm": None}}
    assert "95 % radius" not in with_scores(page, scores(in_radius95=untold))


def test_page_without_a_place_for_scores_is_refused():
    with pytest.raises(ValueError, match="no place for scores"):
        with_scores("<p>something else</p>", scores())


def test_bars_are_as_long_as_their_numbers():
    widths = [
        float(w)
        for w in re.findall(r'<rect x="[^"]*" y="[^"]*" width="([^"]*)"', bars({"a": 10.0, "b": 2.5}, "s", "x"))
    ]
    assert_allclose(widths[1] / widths[0], 0.25, atol=1e-3)


def test_box_spans_the_quartiles_on_a_logarithmic_axis():
    plot = box_plot({"phase": np.array([0.0, 0.5, 1, 2, 5, np.nan]), "none": np.array([np.nan])}, "x")
    ticks = {
        float(t): float(x) for x, t in re.findall(r'<text x="([^"]*)" y="[^"]*" text-anchor="middle">([^<]*)<', plot)
    }
    x, width = re.search(r'<rect x="([^"]*)" y="[^"]*" width="([^"]*)"', plot).groups()
    assert ticks[0.1] == LABEL
    assert_allclose(ticks[1.0] - ticks[0.1], ticks[5.0] - ticks[0.5], atol=0.2)
    assert_allclose([float(x), float(x) + float(width)], [ticks[0.5], ticks[2.0]], atol=0.1)
    assert plot.count("<circle") == 5
    assert f'cx="{LABEL}"' in plot  # no error at all has its place at the axis' start
    assert max(ticks) == 5.0
