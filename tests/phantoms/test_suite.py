"""What the suite holds, and its table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from phantoms import SPECS, SUITE, PhantomCase
from phantoms.measures import affine_share
from phantoms.states import lung_body, make_states
from phantoms.thorax import draw_thorax
from vatsloc.errors import CaseError
from vatsloc.report.planes import box_of
from vatsloc.study.cohort import suite
from vatsloc.study.cohort.contact_sheet import HEIGHT, LABEL, write_sheet
from vatsloc.synthetic.case import read_info, recipe, write_phantom


def test_suite_covers_the_clinic() -> None:
    specs = [SPECS[name] for name in SUITE]
    assert len(specs) >= 12
    assert len(set(SUITE.values())) == len(specs)
    assert {s.side for s in specs} == {"right", "left"}
    assert {s.collapse.gas for s in specs} == {"air", "co2"}
    assert {s.lesion.kind for s in specs} == {"solid", "part-solid", "ground-glass"}
    assert {s.lesion.place for s in specs} == {"middle", "apex", "base"}
    assert min(s.collapse.deflated for s in specs) <= 0.42
    assert max(s.collapse.deflated for s in specs) >= 0.64
    assert sum(s.refused for s in specs) == 1


def test_stiff_even_tissue_on_a_loose_root_moves_almost_as_an_affine_map() -> None:
    spec = replace(SPECS["stiff-lung"], element=28.0)
    person = draw_thorax(spec.side, spec.habitus, spec.lesion, SUITE["stiff-lung"]).patient
    shares = []
    for collapse in (spec.collapse, replace(spec.collapse, stiffness=1.0, root=1.0)):
        rng = np.random.default_rng(0)
        (inflated, deflated), _, _ = make_states(person, replace(spec, collapse=collapse), rng)
        tissue = inflated.samples
        shares.append(affine_share(inflated.lung_map(tissue), deflated.lung_map(tissue)))
    assert 0.10 < shares[0] < 0.14
    assert shares[0] < shares[1] - 0.03


def test_pleura_that_has_grown_to_the_chest_wall_goes_with_it_and_no_other_does() -> None:
    spec = replace(SPECS["adhesion"], element=24.0, fused=1.0)
    grown = replace(spec.collapse, shift=18.0)
    person = draw_thorax(spec.side, spec.habitus, spec.lesion, SUITE["adhesion"]).patient
    body = lung_body(person, grown, spec.element, np.random.default_rng(0))
    scar = body.surface[0][body.grown]
    assert np.ptp(scar, axis=0).max() == pytest.approx(2 * grown.adhesion, rel=0.15)
    off, depth = [], []
    for collapse in (grown, replace(grown, adhesion=0.0)):
        rng = np.random.default_rng(0)
        (_, deflated), _, _ = make_states(person, replace(spec, collapse=collapse), rng)
        off.append(np.linalg.norm(deflated.lung_map(scar) - deflated.motion(scar), axis=1))
        depth.append(deflated.cavity.at(deflated.lung_map(scar)))
    assert off[0].max() < 2.0
    assert np.abs(depth[0]).max() < 2.0
    assert off[1].min() > 8.0


def test_a_case_that_is_there_is_kept_and_tabled(
    demo: PhantomCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vatsloc.synthetic.case.make_case", lambda _name, _seed: demo)
    monkeypatch.setattr(suite, "SUITE", {"demo": 0})
    write_phantom("demo", tmp_path / "demo")
    ct = tmp_path / "demo" / "ct.nii.gz"
    before = ct.stat().st_mtime_ns
    said: list[str] = []
    made = suite.write_suite(tmp_path, say=said.append)
    assert said == ["1 of 1 cases are there, 0 to make"]
    assert ct.stat().st_mtime_ns == before
    assert made["demo"] == read_info(tmp_path / "demo")
    assert {key: made["demo"][key] for key in ("spec", "seed")} == recipe("demo", 0)
    row = suite.table(made).splitlines()[2]
    assert f"| {demo.info['pose_mm'][0]:.1f} / {demo.info['pose_mm'][1]:.1f} |" in row
    assert f"| {100 * demo.info['affine_share'][1]:.0f} |" in row
    leaves = demo.info["total_mm"][0]
    assert f"{leaves:.1f} to {leaves:.1f} mm to the collapsed one" in suite.table(made)
    sheet = tmp_path / "sheet.png"
    write_sheet([tmp_path / "demo"] * 3, sheet)
    picture = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.shape[0] == 2 * (HEIGHT + LABEL)
    lower, upper = box_of(demo.ct.grid)
    scale = HEIGHT / (upper - lower)[1]
    column, line = (upper - demo.nodule_ct)[:2] * scale
    # Flesh is brighter than lung: 25 HU in the window from -1150 to 350, and -880 beside it.
    assert picture[LABEL + round(line), round(column)] == pytest.approx(200, abs=15)
    assert picture[LABEL + round(line - 16 * scale), round(column)] < 100
    with pytest.raises(CaseError, match="is no picture's name"):
        write_sheet([tmp_path / "demo"], tmp_path / "sheet.txt")
