"""Do the tests notice? Puts single faults into the code that decides correctness and counts those that a test kills.

    python tests/mutation.py --number 200 --seed 0 --out DIR [--only GLOB] [--within GLOB] [--jobs 1] [--end-to-end]

Our own, since mutmut leaves out decorated functions (every numba kernel) and cosmic-ray has one test command for all
modules, works in the checkout and draws no sample; neither knows which compiled kernels a change makes stale.
"""

from __future__ import annotations

import argparse
import json
import queue
import random
import signal
import sys
import tempfile
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import asdict
from fnmatch import fnmatch
from functools import partial
from itertools import pairwise
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.faults.copies import Baseline, baseline, copy_tree, entering, judge
from tests.faults.imports import Imports
from tests.faults.mutants import Mutant, mutants, sibling_fields
from tests.faults.table import Name, Record, name_of, table
from tests.faults.warm import Suite

ROOT = Path(__file__).resolve().parents[1]


def named(folder: str, words: str) -> tuple[str, ...]:
    """Test files of a folder by the rest of their names."""
    return tuple(f"tests/{folder}/test_{word}.py" for word in words.split())


# Modules that decide correctness: the test files that judge them, () for those that import them, None for none.
Scope = Mapping[str, tuple[str, ...] | None]
# Rooms whose own tests are slower than others that import them too, or reach them over a front door, name theirs.
SCOPE: Scope = {
    "registration/**/*.py": (),
    "poro/**/*.py": (),
    "poro/contact/*.py": named("poro", "contact hertz contact_pieces separation"),
    "poro/mesh/*.py": named("poro", "mesh mesh_masks rasterize pieces contact fit")
    + named("vatsloc", "shuffled_nodes"),
    "vatsloc/case.py": named("vatsloc", "case case_refused marks new_case greyvalues dicom_regions"),
    "vatsloc/frames.py": (),
    "vatsloc/maps.py": (),
    "vatsloc/results.py": (),
    "vatsloc/evaluation/**/*.py": (),
    "vatsloc/formats/**/*.py": named(
        "vatsloc",
        "formats_images formats_images_refused formats_fields formats_folder formats_markups formats_meshes "
        "formats_transforms malformed_images malformed_marks case marks slicer_scene",
    ),
    "vatsloc/formats/dicom/*.py": named(
        "vatsloc", "formats_dicom dicom_files dicom_series dicom_pixels dicom_regions dicom_malformed dicom_out marks"
    ),
    "vatsloc/imaging/**/*.py": named(
        "vatsloc",
        "imaging_cbct imaging_lung_hint imaging_lungs imaging_pleura greyvalues surface_points hilum_motion new_case",
    ),
    "vatsloc/workflow/**/*.py": (),
    "vatsloc/workflow/stages.py": None,  # seconds, memory and messages
}
DEMO = "tests/vatsloc/test_localize.py"
WHOLE_RUNS = (DEMO, "tests/vatsloc/test_state.py", "tests/vatsloc/test_two_scans.py")  # minutes for each mutant
DEMO_WORDS = ("-k", "not killed and not change_nothing")  # these run the demo again and judge how files are handled
STEPS = 2  # a test judges what it imports, and what that imports
FIRST = (1, 4)  # of them all mutants are put to the first, those that are left to the next, then to the rest
MOST = 12  # test files for one mutant; a number, since seconds would let a busy machine choose
WARM = (
    "pytest hypothesis numpy numpy.testing scipy.sparse.linalg scipy.ndimage scipy.spatial scipy.optimize scipy.stats "
    "scipy.interpolate scipy.linalg numba skfem pyamg pydantic nibabel pydicom nrrd meshio skimage.measure "
    "skimage.segmentation cv2 typer rich jinja2 matplotlib"
)
JUDGED = "tests/mutation_judged.toml"


def drawn(found: Iterable[Mutant], number: int, seed: int) -> list[Mutant]:
    """Mutants drawn at random, one per place at most, every operator in turn; a larger number adds to a smaller."""
    places: dict[str, dict[tuple[str, int, int], list[Mutant]]] = defaultdict(lambda: defaultdict(list))
    for mutant in found:
        places[mutant.operator][mutant.file, mutant.start, mutant.end].append(mutant)
    chance = random.Random(seed)
    piles = []
    for operator in sorted(places):
        pile = [chance.choice(places[operator][place]) for place in sorted(places[operator])]
        chance.shuffle(pile)
        piles.append(pile)
    turns = range(max(map(len, piles), default=0))
    return [pile[turn] for turn in turns for pile in piles if turn < len(pile)][:number]


def in_scope(root: Path, scope: Scope) -> Scope:
    """The scope's entry for each file of the tree, the last one that names it. Exits where an entry names no file."""
    found = {glob: [path.relative_to(root).as_posix() for path in root.glob(glob)] for glob in scope}
    for glob, files in found.items():
        if not files:
            raise SystemExit(f"SCOPE of tests/mutation.py: no file is {glob} any more; name where it went.")
    return {file: scope[glob] for glob, files in found.items() for file in files}


def within_reach(imports: Imports, file: str) -> dict[str, int]:
    """Test files that import a module in few steps, or else those that need the fewest."""
    tests = [test for test in imports.trees if test.startswith("tests/") and Path(test).name.startswith("test_")]
    steps = {test: imports.reached(test).get(file) for test in tests if test not in WHOLE_RUNS}
    found = {test: step for test, step in steps.items() if step is not None}
    limit = max(STEPS, min(found.values(), default=STEPS))
    return {test: step for test, step in found.items() if step <= limit}


def first_in_turn(imports: Imports, steps: Mapping[str, int]) -> list[str]:
    """Test files in the order they run, as many as a mutant is put to: nearest first, then those that reach least."""
    return sorted(steps, key=lambda test: (steps[test], len(imports.reached(test)), test))[:MOST]


def read_records(log: Path) -> dict[Name, Record]:
    """Verdicts written so far, the last one where a mutant has several."""
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return {name_of(record): record for record in map(json.loads, lines)}


def work_off(
    tasks: Iterable[Callable[[Suite], Record | None]], suites: Sequence[Suite], log: Path
) -> dict[Name, Record]:
    """Run each task in a free copy of the tree and write its record as soon as it is there, None for not yet."""
    free: queue.SimpleQueue[Suite] = queue.SimpleQueue()
    for suite in suites:
        free.put(suite)

    def in_free_tree(task: Callable[[Suite], Record | None]) -> Record | None:
        suite = free.get()
        try:
            return task(suite)
        finally:
            free.put(suite)

    records: dict[Name, Record] = {}
    with ThreadPoolExecutor(len(suites)) as pool, log.open("a", encoding="utf-8") as lines:
        try:
            for done in as_completed([pool.submit(in_free_tree, task) for task in tasks]):
                record = done.result()
                if record is None:
                    continue
                lines.write(json.dumps(record) + "\n")
                lines.flush()
                records[name_of(record)] = record
                shown = (record.get(part, "") for part in ("file", "line", "operator", "verdict", "by", "demo"))
                print(len(records), *shown, file=sys.stderr)
        finally:
            pool.shutdown(cancel_futures=True)
    return records


class Baselines:
    """What test files take and enter without a fault, each found out when it is asked for, and kept in a file."""

    def __init__(self, log: Path, words: Sequence[str]) -> None:
        self.log, self.words = log, words
        self.told: dict[str, Baseline] = json.loads(log.read_text("utf-8")) if log.exists() else {}

    def of(self, suite: Suite, test: str) -> Baseline:
        """Of one test file, run in this copy of the tree where it has not been."""
        if test not in self.told:
            self.told[test] = baseline(suite, test, *self.words)
            self.log.write_text(json.dumps(self.told), encoding="utf-8")
        return self.told[test]


def verdicts(found: Sequence[Mutant], judges: Scope, imports: Imports, asked: argparse.Namespace) -> list[Record]:
    """Verdicts on mutants: those written before, the others by the tests, where asked survivors by the demo run."""
    log = asked.out / "mutants.jsonl"
    sample = {name_of(asdict(mutant)): mutant for mutant in found}
    records = {name: record for name, record in read_records(log).items() if name in sample}
    files = {mutant.file for name, mutant in sample.items() if name not in records}
    steps = {file: dict.fromkeys(judges[file] or (), 1) or within_reach(imports, file) for file in files}
    turns = {file: first_in_turn(imports, steps[file]) for file in files}
    without = [f"--deselect={test}" for test in asked.deselect]
    known = Baselines(asked.out / "baseline.json", without)

    def by_tests(first: int, last: int, mutant: Mutant, suite: Suite) -> Record | None:
        function, stale = imports.function(mutant.file, mutant.line), imports.compiled_with(mutant.file)
        record = asdict(mutant) | {"tests": turns[mutant.file], "verdict": "survived", "by": "", "seconds": 0.0}
        tests = turns[mutant.file][first:last]
        new = [[test] for test in tests if test not in known.told]
        for part in ([test for test in tests if test in known.told], *new):  # those whose seconds are known at once
            chosen = {test: dict(entering(known.of(suite, test), function)) for test in part}
            chosen = {test: named for test, named in chosen.items() if named}
            usual = sum(took for named in chosen.values() for took in named.values())
            only = [name for named in chosen.values() for name in named]
            said = judge(suite, mutant, stale, [*chosen, *without] if chosen else [], usual, only)
            record |= said | {"seconds": record["seconds"] + said["seconds"]}
            if said["verdict"] != "survived":
                return record
        return record if last >= len(turns[mutant.file]) else None

    def by_demo(record: Record, suite: Suite) -> Record:
        mutant = sample[name_of(record)]
        words = [DEMO, *DEMO_WORDS, *without]
        said = judge(suite, mutant, imports.compiled_with(mutant.file), words, demo_seconds)
        return record | {"demo": said["by"] or said["verdict"]}

    with tempfile.TemporaryDirectory(prefix="mutation-") as base, ExitStack() as open_suites:
        trees = [Path(base, str(job), "tree") for job in range(asked.jobs)]
        for tree in trees:
            copy_tree(imports.root, tree, asked.out)
        suites = [open_suites.enter_context(Suite(tree, asked.warm.split())) for tree in trees]
        for first, last in pairwise((0, *FIRST, MOST)):
            left = [mutant for name, mutant in sample.items() if name not in records]
            records |= work_off([partial(by_tests, first, last, mutant) for mutant in left], suites, log)
        alive = [record for record in records.values() if record["verdict"] == "survived" and "demo" not in record]
        if alive and asked.end_to_end:
            demo_seconds = sum(took for _, took in baseline(suites[0], DEMO, *DEMO_WORDS, *without)["tests"])
            records |= work_off([partial(by_demo, record) for record in alive], suites, log)
    return [records[name] for name in sample]


def main(words: Sequence[str] | None = None, root: Path = ROOT, scope: Scope = SCOPE) -> None:
    """The command line. root, scope: another tree and its modules, for the tests of this script."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=200, help="mutants to draw")
    parser.add_argument("--seed", type=int, default=0, help="of the draw; a larger number adds to a smaller")
    parser.add_argument("--out", type=Path, required=True, help="folder of mutants.jsonl and table.md, taken up again")
    parser.add_argument("--only", default="*", help="glob of the modules' paths to draw from")
    parser.add_argument("--within", default="*", help="glob of the paths to judge now, of those drawn; others later")
    parser.add_argument("--jobs", type=int, default=1, help="mutants judged at a time, each in a copy of its own")
    parser.add_argument("--end-to-end", action="store_true", help="put survivors to the demo run too")
    parser.add_argument("--deselect", action="append", default=[], help="test that fails here without a fault too")
    parser.add_argument("--warm", default=WARM, help="modules imported once, not for every mutant")
    asked = parser.parse_args(words)
    asked.out.mkdir(parents=True, exist_ok=True)

    imports = Imports(root)
    judges = in_scope(root, scope)
    files = sorted(file for file, tests in judges.items() if tests is not None and fnmatch(file, asked.only))
    siblings = sibling_fields(imports.trees[file] for file in files)
    found = [mutant for file in files for mutant in mutants(file, (root / file).read_text("utf-8"), siblings)]
    sample = [mutant for mutant in drawn(found, asked.number, asked.seed) if fnmatch(mutant.file, asked.within)]
    records = verdicts(sample, judges, imports, asked)
    reasons = root / JUDGED
    entries = tomllib.loads(reasons.read_text("utf-8"))["judged"] if reasons.exists() else []
    text = table(records, entries, asked.seed)
    (asked.out / "table.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended; the same command goes on from here"))
    main()
