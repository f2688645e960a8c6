"""Values taken apart into JSON and arrays, and put together again."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from registration.spine import RigidStatus
from registration.volume import Mask, Volume
from vatsloc.formats.trees import digest, flattened, restored

AFFINE = np.diag([1.0, 2.0, 3.0, 1.0])
IMAGE = Volume(np.arange(24, dtype=np.float32).reshape(2, 3, 4), AFFINE)


def there_and_back(value: Any) -> Any:
    plain, arrays = flattened(value)
    return restored(json.loads(json.dumps(plain)), arrays)


def test_containers_numbers_and_enums_come_back_as_they_were() -> None:
    value = {"a": (1, 2.5, None), "b": [True, "of"], "array": {"map": np.inf}, "c": RigidStatus.POOR, "d": ()}
    back = there_and_back(value)
    assert back == value
    assert back["c"] is RigidStatus.POOR


def test_dataclasses_come_back_with_each_array_stored_once() -> None:
    plain, arrays = flattened((IMAGE, Mask(IMAGE.hu > 3, AFFINE)))
    assert len(arrays) == 3  # two images' voxels, one affine
    image, mask = restored(plain, arrays)
    assert isinstance(image, Volume)
    np.testing.assert_array_equal(image.hu, IMAGE.hu)
    np.testing.assert_array_equal(mask.inside, IMAGE.hu > 3)
    assert mask.ras_from_ijk is image.ras_from_ijk


def test_a_float_comes_back_to_the_last_bit() -> None:
    assert there_and_back(np.float64(0.1) + 0.2) == 0.1 + 0.2


def test_nothing_but_this_programs_own_is_taken_apart_or_put_together() -> None:
    with pytest.raises(TypeError, match="set is no dataclass"):
        flattened({1})
    for name, why in (("os.system", "is not of"), ("vatsloc.errors.as_ours", "neither"), ("vatsloc.no.A", "not known")):
        with pytest.raises(ValueError, match=why):
            restored({"of": name, "with": {}}, [])
    with pytest.raises(ValueError, match="'pickle' is no kind"):
        restored({"pickle": "x"}, [])


@pytest.mark.parametrize(
    "other",
    [
        replace(IMAGE, hu=IMAGE.hu + np.float32(1e-6) * (IMAGE.hu == 1)),
        replace(IMAGE, hu=IMAGE.hu.reshape(3, 2, 4)),
        replace(IMAGE, hu=IMAGE.hu.astype(np.float64)),
        replace(IMAGE, ras_from_ijk=np.diag([1.0, 2.0, 3.5, 1.0])),
    ],
)
def test_digest_tells_every_difference_and_nothing_else(other: Any) -> None:
    same = Volume(np.asfortranarray(IMAGE.hu), AFFINE.copy())
    assert digest(same) == digest(IMAGE)
    assert digest(other) != digest(IMAGE)
