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
from dataclasses import asdict
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.faults.copies import baseline, copy_tree, judge
from tests.faults.imports import Imports
from tests.faults.mutants import Mutant, mutants, sibling_fields
from tests.faults.table import Name, Record, name_of, table

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
    "poro/contact/*.py": named("poro", "contact hertz"),
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
        "vatsloc", "formats_dicom dicom_files dicom_series dicom_pixels dicom_regions dicom_malformed marks"
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
MOST = 12  # test files for one mutant; a number, since seconds would let a busy machine choose
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


def first_in_turn(steps: Mapping[str, int], seconds: Mapping[str, float]) -> list[str]:
    """Test files in the order they run, nearest and fastest first, as many as a mutant is put to."""
    return sorted(steps, key=lambda test: (steps[test], seconds[test]))[:MOST]


def read_records(log: Path) -> dict[Name, Record]:
    """Verdicts written so far, the last one where a mutant has several."""
    lines = log.read_text(encoding="utf-8").splitlines() if log.exists() else []
    return {name_of(record): record for record in map(json.loads, lines)}


def work_off(tasks: Iterable[Callable[[Path], Record]], trees: Sequence[Path], log: Path) -> dict[Name, Record]:
    """Run each task in a free copy of the tree and write its record as soon as it is there."""
    free: queue.SimpleQueue[Path] = queue.SimpleQueue()
    for tree in trees:
        free.put(tree)

    def in_free_tree(task: Callable[[Path], Record]) -> Record:
        tree = free.get()
        try:
            return task(tree)
        finally:
            free.put(tree)

    records: dict[Name, Record] = {}
    with ThreadPoolExecutor(len(trees)) as pool, log.open("a", encoding="utf-8") as lines:
        try:
            for done in as_completed([pool.submit(in_free_tree, task) for task in tasks]):
                record = done.result()
                lines.write(json.dumps(record) + "\n")
                lines.flush()
                records[name_of(record)] = record
                shown = (record.get(part, "") for part in ("file", "line", "operator", "verdict", "by", "demo"))
                print(len(records), *shown, file=sys.stderr)
        finally:
            pool.shutdown(cancel_futures=True)
    return records


def verdicts(found: Sequence[Mutant], judges: Scope, imports: Imports, asked: argparse.Namespace) -> list[Record]:
    """Verdicts on mutants: those written before, the others by the tests, where asked survivors by the demo run."""
    log = asked.out / "mutants.jsonl"
    sample = {name_of(asdict(mutant)): mutant for mutant in found}
    records = {name: record for name, record in read_records(log).items() if name in sample}
    waiting = [mutant for name, mutant in sample.items() if name not in records]
    files = {mutant.file for mutant in waiting}
    steps = {file: dict.fromkeys(judges[file] or (), 1) or within_reach(imports, file) for file in files}

    def by_tests(mutant: Mutant, tree: Path) -> Record:
        tests = first_in_turn(steps[mutant.file], seconds)
        usual = sum(seconds[test] for test in tests)
        said = judge(tree, mutant, imports.compiled_with(mutant.file), [*tests, *without] if tests else [], usual)
        return asdict(mutant) | {"tests": tests} | said

    def by_demo(record: Record, tree: Path) -> Record:
        mutant = sample[name_of(record)]
        said = judge(tree, mutant, imports.compiled_with(mutant.file), [DEMO, *DEMO_WORDS, *without], demo_seconds)
        return record | {"demo": said["by"] or said["verdict"]}

    without = [f"--deselect={test}" for test in asked.deselect]
    with tempfile.TemporaryDirectory(prefix="mutation-") as base:
        trees = [Path(base, str(job), "tree") for job in range(asked.jobs)]
        copy_tree(imports.root, trees[0], asked.out)
        reached = sorted({test for tests in steps.values() for test in tests})
        seconds = baseline(trees[0], reached, *without, log=asked.out / "seconds.json")
        for tree in trees[1:]:
            copy_tree(trees[0], tree, asked.out)
        records |= work_off([partial(by_tests, mutant) for mutant in waiting], trees, log)
        alive = [record for record in records.values() if record["verdict"] == "survived" and "demo" not in record]
        if alive and asked.end_to_end:
            demo_seconds = sum(baseline(trees[0], [DEMO], *DEMO_WORDS, *without).values())
            records |= work_off([partial(by_demo, record) for record in alive], trees, log)
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
