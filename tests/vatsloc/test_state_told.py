"""What a folder must hold to be taken for a prepared state, without a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from vatsloc.workflow.state import PROGRAM, STATE_FILE, _laid_out, _order, _stored, is_state

WHOLE: dict[str, Any] = {"program": PROGRAM, "key": {"ct": "c0"}, "layout": [], "state": {}}


def told(folder: Path, what: object) -> bool:
    (folder / STATE_FILE).write_text(json.dumps(what), encoding="utf-8")
    return is_state(folder)


def test_a_folder_whose_file_has_all_parts_and_our_name_is_a_state(tmp_path: Path) -> None:
    assert not is_state(tmp_path)
    assert told(tmp_path, WHOLE)
    (tmp_path / STATE_FILE).write_text("{", encoding="utf-8")
    assert not is_state(tmp_path)


@pytest.mark.parametrize("part", list(WHOLE))
def test_one_that_lacks_a_part_is_none(tmp_path: Path, part: str) -> None:
    assert not told(tmp_path, {name: value for name, value in WHOLE.items() if name != part})


@pytest.mark.parametrize("changed", [{"program": "another"}, {"key": ["ct"]}])
def test_another_program_s_or_a_key_of_another_kind_is_none(tmp_path: Path, changed: dict[str, Any]) -> None:
    assert not told(tmp_path, WHOLE | changed)
    assert not told(tmp_path, [WHOLE])


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
@pytest.mark.parametrize("kind", ["float32", "bool"])
def test_an_array_comes_back_as_it_lay_in_memory(kind: str, axes: tuple[int, int, int]) -> None:
    values = (np.arange(30) % 7 % 2 if kind == "bool" else np.arange(30)).astype(kind)
    array = values.reshape(2, 3, 5).transpose(axes)
    again = _laid_out(_stored(array), list(array.shape), array.dtype.str, _order(array).tolist())
    assert_array_equal(again, array)
    assert again.dtype == array.dtype
    assert again.strides == array.strides
