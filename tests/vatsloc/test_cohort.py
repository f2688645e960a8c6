"""Many cases run by a stand-in for the command line: tables by value, crashes that stop no other, and going on."""

from __future__ import annotations

import csv
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from vatsloc.errors import CaseError
from vatsloc.study.bench import fit as fits
from vatsloc.study.cohort.cohort import Outcome, as_json, find_cases, run_cohort, summary, table

PROGRAM = """
import json, os, signal, sys
from pathlib import Path
command, case, *rest = sys.argv[1:]
name = Path(case).name
with open(Path(__file__).with_name("calls"), "a") as calls:
    calls.write(f"{command} {name}\\n")
if command == "localize":
    if name == "refused":
        print("vatsloc: no lung in sight", file=sys.stderr)
        sys.exit(3)
    if name == "crash" and not Path(__file__).with_name("mended").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    out = Path(rest[1])
    out.mkdir(exist_ok=True)
    gates = {"view": {"ok": True}, "fissures": {"ok": name != "gated"}}
    peak = 123.0 + int(os.environ["NUMBA_NUM_THREADS"])
    seconds = {"total": 9.0, "fit": 2.0, "keypoints": 0.5, "warp": 4.0}
    (out / "run.json").write_text(json.dumps({"gates": gates, "peak_mb": peak, "seconds": seconds}))
    if name == "gated":
        print("vatsloc: do not trust it", file=sys.stderr)
        sys.exit(5)
else:
    if name == "bare":
        print("vatsloc: no landmarks", file=sys.stderr)
        sys.exit(2)
    mm = {"good": 1.0, "gated": 15.0, "wrong": 12.0, "crash": 2.0}[name]
    errors = {"mean": mm, "p95": 2 * mm, "max": 3 * mm}
    scores = {"phase1": errors, "phase2": errors, "chain": errors}
    scores |= {"nodule_deflated_mm": mm / 2, "nodule_in_ellipsoid95": mm < 5}
    if name in ("good", "gated"):
        tissue = {"chain": {"mean": 2.5 if name == "gated" else 1.5, "p95": 4.0, "max": 9.0}}
        shallow = [{"from_mm": f, "to_mm": f + 5, "n": 100 + f, "chain": {"mean": 3.0 - f / 5, "p95": 6.0 - f / 5},
                    "share_in_radius95": 0.9 + f / 50} for f in (0.0, 5.0)]
        deeper = [{"from_mm": f, "to_mm": t, "n": 0, "chain": None, "share_in_radius95": None}
                  for f, t in ((10.0, 20.0), (20.0, 30.0), (30.0, None))]
        scores["dense"] = {"inside_fov": tissue, "by_depth": shallow + deeper}
        scores["nodule_deflated_mm"] = 2.9 if name == "gated" else 0.5
    (Path(rest[0]) / "tre.json").write_text(json.dumps(scores))
"""
NAMES = ("good", "gated", "wrong", "crash", "refused", "bare")


@pytest.fixture
def cases(tmp_path: Path) -> list[Path]:
    for name in NAMES:
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "case.toml").write_text("")
    return [tmp_path / "cases" / name for name in NAMES]


@pytest.fixture
def program(tmp_path: Path) -> tuple[str, ...]:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return (sys.executable, str(path))


def test_every_case_gets_its_line_although_one_crashes(
    cases: list[Path], program: tuple[str, ...], tmp_path: Path
) -> None:
    outcomes = {o.name: o for o in run_cohort(cases, tmp_path / "out", jobs=99, program=program)}
    assert [o.exit_code for o in outcomes.values()] == [0, 5, 0, -9, 3, 0]
    assert [o.silent_failure for o in outcomes.values()] == [False, False, True, None, None, None]
    assert outcomes["gated"].failed_gates == ["fissures"]
    assert outcomes["refused"].says == "vatsloc: no lung in sight"
    assert outcomes["good"].peak_mb == 124.0
    assert outcomes["refused"].peak_mb > 5
    with (tmp_path / "out" / "cohort.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["case"] for row in rows] == list(NAMES)
    assert [rows[0][key] for key in ("chain_mean_mm", "phase1_p95_mm", "phase2_max_mm")] == ["1.0", "2.0", "3.0"]
    page = (tmp_path / "out" / "cohort.html").read_text()
    assert page.count("<tr class=") == len(NAMES)
    assert '<tr class="silent">' in page
    assert "http" not in page
    lines = (tmp_path / "out" / "cohort.md").read_text().splitlines()
    assert lines[2].startswith(
        "| good | 0 | 1.00 / 2.00 / 3.00 | 1.00 / 2.00 / 3.00 | 1.00 / 2.00 / 3.00 | 3.00 / 6.00 | 2.00 / 5.00 | 0.50 "
    )
    assert "holds the nodule in 1 of 3 cases (1 of 2 under exit code 0)" in lines[-1]
    assert (
        "mean of the cases / median of their 95 %, mm: 3.0 / 6.0 at 0 to 5 mm, 2.0 / 5.0 at 5 to 10 mm. " in lines[-1]
    )
    assert "tissue in view by depth below the pleura: 90.0 % at 0 to 5 mm, 100.0 % at 5 to 10 mm. False" in lines[-1]
    assert "(a gate failed, yet nodule and tissue are right to 3 mm on average): 1 of 2." in lines[-1]
    assert [outcomes[name].false_alarm for name in ("good", "gated", "wrong")] == [False, True, None]
    assert (rows[0]["tissue_0_5_mean_mm"], rows[0]["tissue_5_10_p95_mm"], rows[2]["tissue_0_5_mean_mm"]) == (
        "3.0",
        "5.0",
        "",
    )
    assert (rows[1]["tissue_in_view_mm"], rows[1]["false_alarm"]) == ("2.5", "True")
    assert lines[-1].endswith("Silent failures (nodule or mean landmark error over 10 mm under exit code 0): 1 of 3.")


def test_a_rerun_takes_up_only_what_crashed_or_changed(
    cases: list[Path], program: tuple[str, ...], tmp_path: Path
) -> None:
    run_cohort(cases, tmp_path / "out", jobs=3, program=program)
    (tmp_path / "mended").touch()
    (tmp_path / "calls").unlink()
    os.utime(cases[0] / "case.toml", ns=(1, 1))
    outcomes = run_cohort(cases, tmp_path / "out", program=program)
    assert (tmp_path / "calls").read_text().split("\n")[:-1] == [
        f"{command} {name}" for name in ("good", "crash") for command in ("localize", "evaluate")
    ]
    assert [o.exit_code for o in outcomes] == [0, 5, 0, 0, 3, 0]
    run_cohort(cases[:1], tmp_path / "out", preset="fast", program=program)
    assert (tmp_path / "calls").read_text().count("localize good") == 2


def test_coverage_and_silent_failures_are_shares_of_what_can_be_told() -> None:
    errors = {"mean": 9.0, "p95": 9.0, "max": 9.0}
    scores = {"phase1": errors, "phase2": errors, "chain": errors, "nodule_in_ellipsoid95": False}
    right = {"nodule_deflated_mm": 9.9, "nodule_in_ellipsoid95": True}
    outcomes = [
        Outcome("a", 0, 1.0, 1.0, "", [], 0, scores | {"nodule_deflated_mm": 10.1} | _held(0.75, 40), []),
        Outcome("b", 0, 1.0, 1.0, "", [], 0, scores | right | _held(1.0, 20), []),
        Outcome("c", 3, 1.0, 1.0, "a | b", [], None, None, []),
    ]
    assert as_json(outcomes)["coverage95"] == 0.5
    assert as_json(outcomes)["silent_failure_share"] == 0.5
    assert summary(outcomes).startswith("3 cases, 2 with exit code 0, 1 with 3.")
    assert "radius holds 50 of 60 landmarks" in summary(outcomes)
    assert [case["landmarks_in_radius95"] for case in as_json(outcomes)["cases"]] == [0.75, 1.0, None]
    assert "| a / b |" in table(outcomes)
    assert "| 30 of 40 |" in table(outcomes)


def test_nodules_are_told_by_the_images_that_show_them() -> None:
    errors = {"mean": 1.0, "p95": 2.0, "max": 3.0}

    def of(seen: str | None, nodule_mm: float, held: bool) -> Outcome:
        scores = {"phase1": errors, "phase2": errors, "chain": errors, "nodule_in_ellipsoid95": held}
        scores["nodule_deflated_mm"] = nodule_mm
        return Outcome("a", 0, 1.0, 1.0, "", [], 0, scores, [], seen)

    told = summary([of("ct", 2.0, True), of("ct", 6.0, False), of("all", 0.5, True), of(None, 9.0, False)])
    assert "0.5 / 0.5, 1 of 1 in their ellipsoid, where all images show them; " in told
    assert "; 4.0 / 5.8, 1 of 2 in their ellipsoid, where neither cone-beam image does. " in told
    assert "where the deflated image does not" not in told
    assert as_json([of("ct", 2.0, True)])["cases"][0]["nodule_seen"] == "ct"


def _held(share: float, n: int) -> dict[str, Any]:
    return {"in_radius95": {"landmarks": {"share": share, "n": n, "median_mm": 5.0}}}


def test_bench_fit_tells_errors_seconds_coverage_and_silent_failures(
    cases: list[Path], program: tuple[str, ...], tmp_path: Path
) -> None:
    result = fits.bench_fit([tmp_path / "cases"], tmp_path / "out", jobs=3, program=program)
    rows = {row["name"]: row for row in result["cases"]}
    assert list(rows) == sorted(NAMES)
    good = rows["good"] | {"seconds": None}
    assert good == {
        "name": "good",
        "seconds": None,
        "seconds_fit": 2.5,
        "chain_mean": 1.0,
        "nodule_mm": 0.5,
        "in_ellipsoid95": True,
        "exit_code": 0,
    }
    assert rows["good"]["seconds"] > 0
    assert rows["refused"]["chain_mean"] is rows["refused"]["seconds_fit"] is None
    assert result["silent_failure_share"] == pytest.approx(1 / 3)
    assert result["coverage95"] == pytest.approx(1 / 3)
    assert "| refused | " in fits.table(result)
    assert "None" not in fits.table(result)
    assert fits.table(result).endswith(
        "Silent failures (nodule or mean landmark error over 10 mm under exit code 0): 1 of 3."
    )
    (tmp_path / "calls").unlink()
    fits.bench_fit(cases[:1], tmp_path / "out", program=program)
    assert not (tmp_path / "calls").exists()


def test_cases_are_found_once_and_names_are_unique(cases: list[Path], tmp_path: Path) -> None:
    assert find_cases([tmp_path / "cases", cases[0]]) == sorted(cases)
    with pytest.raises(CaseError, match="holds no case"):
        find_cases([cases[0], tmp_path])
    (tmp_path / "more" / "good").mkdir(parents=True)
    (tmp_path / "more" / "good" / "case.toml").touch()
    with pytest.raises(CaseError, match="two cases are called good"):
        find_cases([tmp_path / "cases", tmp_path / "more"])


def test_a_scheduler_without_dask_is_refused(
    cases: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CaseError, match="--scheduler needs Dask"):
        run_cohort(cases, tmp_path / "out", scheduler="tcp://nowhere:8786")
