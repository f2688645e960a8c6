"""A results folder is whole or absent, whatever happens to the run that writes it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from vatsloc.errors import CaseError
from vatsloc.formats import folder
from vatsloc.formats.folder import is_result, remove_leftovers, whole_folder, write_whole

N_FILES = 30

WRITER = f"""
import json, sys
from pathlib import Path
from vatsloc.formats.folder import whole_folder
generation = int(sys.argv[2])
print("started", flush=True)
while True:
    generation += 1
    with whole_folder(Path(sys.argv[1])) as folder:
        for n in range({N_FILES}):
            (folder / f"part{{n}}.txt").write_text(str(generation) * 2000)
        (folder / "run.json").write_text(json.dumps({{"program": "vatsloc", "generation": generation}}))
"""


def generation(target: Path) -> int:
    """The generation all files of a result agree on."""
    run = json.loads((target / "run.json").read_text())["generation"]
    assert {(target / f"part{n}.txt").read_text() for n in range(N_FILES)} == {str(run) * 2000}
    assert len(list(target.iterdir())) == N_FILES + 1
    return run


def hidden(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def write_result(target: Path, text: str) -> None:
    with whole_folder(target) as folder:
        (folder / "run.json").write_text(json.dumps({"program": "vatsloc", "text": text}))


def text_of(target: Path) -> str:
    return json.loads((target / "run.json").read_text())["text"]


def test_killing_the_writer_never_leaves_a_half_written_result(tmp_path):
    target, rng, seen = tmp_path / "out", np.random.default_rng(3), []
    for attempt in range(8):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(target), str(1000 * attempt)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(float(rng.uniform(0.02, 0.2)))
        process.kill()
        process.communicate()
        if target.exists():
            generation(target)
        # A kill before the folder has its lock leaves an empty one, which counts as a leftover only when it is old.
        for new in tmp_path.glob(".out.new-*"):
            assert list(new.iterdir()) == []
            os.utime(new, (0, 0))
        remove_leftovers(target)
        assert hidden(tmp_path) == []
        if target.exists():
            seen.append(generation(target))
    assert seen == sorted(seen)
    assert len(set(seen)) > 3


def test_a_run_at_work_is_not_mistaken_for_a_leftover(tmp_path):
    with whole_folder(tmp_path / "out") as first:
        (first / "run.json").write_text('{"program": "vatsloc", "text": "first"}')
        write_result(tmp_path / "out", "second")
        assert text_of(tmp_path / "out") == "second"
    assert text_of(tmp_path / "out") == "first"
    assert hidden(tmp_path) == []


def test_a_run_killed_between_the_two_renames_gets_its_old_result_back(tmp_path):
    write_result(tmp_path / "out", "old")
    (tmp_path / "out").rename(tmp_path / ".out.replaced-0123abcd")
    remove_leftovers(tmp_path / "out")
    assert text_of(tmp_path / "out") == "old"
    assert hidden(tmp_path) == []


def test_leftovers_of_other_results_stay(tmp_path):
    (tmp_path / ".other.partial-0123abcd").mkdir()
    write_result(tmp_path / "out", "new")
    assert hidden(tmp_path) == [".other.partial-0123abcd"]


def test_a_leftover_that_another_run_removes_at_the_same_time_is_no_error(tmp_path, monkeypatch):
    (tmp_path / ".out.partial-0123abcd").mkdir()

    def removed_by_the_other_run(leftover):
        leftover.rmdir()
        return False

    monkeypatch.setattr(folder, "_locked", removed_by_the_other_run)
    remove_leftovers(tmp_path / "out")
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_the_earlier_result_and_nothing_else(tmp_path, error):
    write_result(tmp_path / "out", "old")

    def fail():
        with whole_folder(tmp_path / "out") as folder:
            (folder / "run.json").write_text("{}")
            raise error

    with pytest.raises(error):
        fail()
    assert text_of(tmp_path / "out") == "old"
    assert hidden(tmp_path) == []


def test_an_exception_is_told_even_if_its_folder_is_gone(tmp_path):
    def fail():
        with whole_folder(tmp_path / "out") as folder:
            folder.rmdir()
            raise ValueError("first cause")

    with pytest.raises(ValueError, match="first cause"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_at_the_target_before_the_end(tmp_path):
    target = tmp_path / "new" / "deep" / "out"
    with whole_folder(target) as folder:
        (folder / "run.json").write_text('{"program": "vatsloc"}')
        assert not target.exists()
        assert folder.parent == target.parent
    assert is_result(target)


def test_an_incomplete_result_is_not_made(tmp_path):
    with (
        pytest.raises(RuntimeError, match=r"a\.nii\.gz, b\.vtu not written"),
        whole_folder(tmp_path / "out", expected=("a.nii.gz", "b.vtu", "c.stl")) as folder,
    ):
        (folder / "c.stl").write_text("")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_filled(tmp_path):
    (tmp_path / "out").mkdir()
    write_result(tmp_path / "out", "new")
    assert text_of(tmp_path / "out") == "new"


@pytest.mark.parametrize("run", [None, "no json", '{"program": "another"}', "[1]"])
def test_a_folder_with_other_files_is_refused(tmp_path, run):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("two years of work")
    if run is not None:
        (tmp_path / "out" / "run.json").write_text(run)
    with pytest.raises(CaseError, match="files that vatsloc did not write; give an empty or a new folder"):
        write_result(tmp_path / "out", "new")
    assert (tmp_path / "out" / "thesis.tex").read_text() == "two years of work"


def test_a_file_is_refused(tmp_path):
    (tmp_path / "out").write_text("text")
    with pytest.raises(CaseError, match="is a file; give the name of a folder"):
        write_result(tmp_path / "out", "new")


def test_a_link_to_a_result_keeps_being_a_link(tmp_path):
    write_result(tmp_path / "real", "old")
    (tmp_path / "out").symlink_to(tmp_path / "real")
    write_result(tmp_path / "out", "new")
    assert (tmp_path / "out").is_symlink()
    assert text_of(tmp_path / "real") == "new"


def test_one_file_is_replaced_whole(tmp_path):
    write_whole(tmp_path / "tre.json", "old")
    write_whole(tmp_path / "tre.json", "new")
    assert (tmp_path / "tre.json").read_text() == "new"
    with pytest.raises(UnicodeEncodeError):
        write_whole(tmp_path / "tre.json", "\ud800")
    assert (tmp_path / "tre.json").read_text() == "new"
    assert hidden(tmp_path) == []
