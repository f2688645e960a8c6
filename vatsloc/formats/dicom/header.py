"""Values of a DICOM header, all read through one guard: what is not of the kind the standard asks for is refused.

A refusal names the file, the attribute and what was found. Nothing else in this package touches a value of a header.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.config import IGNORE, settings
from pydicom.dataset import Dataset
from pydicom.errors import InvalidDicomError
from pydicom.sequence import Sequence

from registration.volume import Array
from vatsloc.errors import InputRefused

settings.reading_validation_mode = IGNORE  # values are judged here, in our words, instead of by warnings on stderr

_SHOWN = 60


@dataclass(frozen=True)
class Header:
    """A data set, or an item of a sequence in it, and the file it came from."""

    dataset: Dataset
    file: Path

    def __contains__(self, name: str) -> bool:
        return name in self.dataset

    def value(self, name: str) -> Any:
        """Value of an attribute as pydicom gives it, None where it is absent or empty."""
        try:
            value = self.dataset.get(name)
        except Exception as error:  # pydicom converts on access, and raises whatever the conversion raises
            raise self.wrong(name, str(error).splitlines()[0] if str(error) else "?", "a readable value") from error
        return None if value is None or (hasattr(value, "__len__") and len(value) == 0) else value

    def text(self, name: str) -> str:
        """Text of an attribute, "" where it is absent or empty; several values are joined by a backslash."""
        value = self.value(name)
        if value is None:
            return ""
        return "\\".join(map(str, value)) if isinstance(value, (list, pydicom.multival.MultiValue)) else str(value)

    def numbers(self, name: str, n: int) -> Array:
        """The n finite numbers of an attribute, (n,). Raises InputRefused for anything else."""
        value = self.value(name)
        if value is None:
            if name in self.dataset:
                raise self.wrong(name, "nothing", _numbers(n))
            raise InputRefused(f"{self.file} states no {name}; export it again with its whole header.")
        try:
            numbers = np.atleast_1d(np.asarray(value, dtype=float))
        except (TypeError, ValueError, OverflowError) as error:
            raise self.wrong(name, value, _numbers(n)) from error
        if numbers.shape != (n,) or not np.isfinite(numbers).all():
            raise self.wrong(name, value, _numbers(n))
        return numbers

    def number(self, name: str, default: float | None = None) -> float:
        """One finite number; `default` where the attribute is absent. Raises InputRefused for anything else."""
        if default is not None and name not in self.dataset:
            return default
        return float(self.numbers(name, 1)[0])

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """One whole number within [low, high]; `default` where absent. Raises InputRefused for anything else."""
        number = self.number(name, default)
        if number != round(number) or not low <= number <= high:
            raise self.wrong(name, f"{number:g}", f"a whole number from {low} to {high}")
        return int(number)

    def items(self, name: str) -> list[Header]:
        """Items of a sequence, [] where it is absent or empty."""
        value = self.value(name)
        if value is None:
            return []
        if not isinstance(value, Sequence):
            raise self.wrong(name, value, "a sequence")
        return [Header(item, self.file) for item in value]

    def wrong(self, name: str, found: object, needed: str) -> InputRefused:
        """The refusal of a malformed value."""
        shown = str(found)
        shown = shown if len(shown) <= _SHOWN else shown[:_SHOWN] + "..."
        return InputRefused(
            f"{self.file} states {name} = {shown}, {needed} needed; correct the header or export it again."
        )


def read_header(file: Path, pixels: bool = False) -> Header | None:
    """Header of a DICOM file, without its pixels unless asked for; None when the file is no DICOM.

    Raises InputRefused when it is DICOM and cannot be read.
    """
    try:
        return Header(pydicom.dcmread(file, stop_before_pixels=not pixels), file)
    except InvalidDicomError:
        return None
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputRefused(f"{file} is not a readable DICOM file ({reason}); copy or export it again.") from error


def _numbers(n: int) -> str:
    return "a number" if n == 1 else f"{n} numbers"
