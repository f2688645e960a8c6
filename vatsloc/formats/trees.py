"""Frozen dataclasses of arrays as one JSON text and a list of arrays, and back; their digest.

Not a pickle: what is read can only be numbers, text, containers, arrays, and this program's own dataclasses and enums,
so that opening a file runs nothing that the file brings along.
"""

from __future__ import annotations

import hashlib
import importlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np

from registration.volume import Array

OURS = ("registration", "poro", "vatsloc")
"""Packages whose dataclasses and enums are known."""


def flattened(value: Any) -> tuple[Any, list[Array]]:
    """Plain JSON that stands for `value`, and the arrays that it numbers, each once. Raises TypeError for other kinds.

    Values: None, bool, int, float, str, tuples, lists, mappings with text for keys, arrays, and `OURS`.
    """
    arrays: list[Array] = []
    return _flat(value, arrays, {}), arrays


def restored(plain: Any, arrays: Sequence[Array]) -> Any:
    """The value that `flattened` took apart. Raises ValueError where `plain` is none of its making."""
    if isinstance(plain, list):
        return [restored(item, arrays) for item in plain]
    if not isinstance(plain, dict):
        return plain
    (kind, held), *more = plain.items()
    if kind == "tuple":
        return tuple(restored(item, arrays) for item in held)
    if kind == "map":
        return {key: restored(item, arrays) for key, item in held.items()}
    if kind == "array":
        return arrays[held]
    if kind == "enum":
        return _ours(held[0], Enum)[held[1]]
    if kind == "of" and more:
        return _ours(held, None)(**{key: restored(item, arrays) for key, item in more[0][1].items()})
    raise ValueError(f"{kind!r} is no kind of value")


def digest(value: Any) -> str:
    """Of a value that `flattened` knows: equal where all its numbers, texts and arrays are."""
    plain, arrays = flattened(value)
    told = hashlib.blake2b(json.dumps(plain, sort_keys=True).encode(), digest_size=16)
    for array in arrays:
        told.update(f"{array.dtype.str}{array.shape}".encode())
        told.update(np.ascontiguousarray(array).data)
    return told.hexdigest()


def _flat(value: Any, arrays: list[Array], known: dict[int, int]) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        if id(value) not in known:
            known[id(value)] = len(arrays)
            arrays.append(value)
        return {"array": known[id(value)]}
    if isinstance(value, tuple):
        return {"tuple": [_flat(item, arrays, known) for item in value]}
    if isinstance(value, list):
        return [_flat(item, arrays, known) for item in value]
    if isinstance(value, Mapping):
        return {"map": {str(key): _flat(item, arrays, known) for key, item in value.items()}}
    name = f"{type(value).__module__}.{type(value).__qualname__}"
    if isinstance(value, Enum) and name.partition(".")[0] in OURS:
        return {"enum": [name, value.name]}
    if is_dataclass(value) and name.partition(".")[0] in OURS:
        return {"of": name, "with": {f.name: _flat(getattr(value, f.name), arrays, known) for f in fields(value)}}
    raise TypeError(f"{name} is no dataclass of {', '.join(OURS)}, array, number, text or container of these")


def _ours(name: str, base: type | None) -> Any:
    module, _, kind = name.rpartition(".")
    if module.partition(".")[0] not in OURS:
        raise ValueError(f"{name} is not of {', '.join(OURS)}")
    try:
        found = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{name} is not known ({error})") from error
    if not isinstance(found, type) or not (is_dataclass(found) if base is None else issubclass(found, base)):
        raise ValueError(f"{name} is neither a dataclass nor an enum")
    return found
