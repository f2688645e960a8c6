"""case.toml: which files make a case, and what is known about it; unknown keys and wrong types are refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from vatsloc.errors import CaseError
from vatsloc.formats.guard import reading
from vatsloc.frames import Side

FILE_NAME = "case.toml"
GRAVITY_LENGTH_TOLERANCE = 0.05
"""How far from 1 the length of gravity may be; components rounded to one digit stay within it."""

PleuralGas = Literal["air", "co2"]
Coordinate = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Slope = Annotated[float, Field(allow_inf_nan=False, strict=True, gt=0)]
Triple = tuple[Coordinate, Coordinate, Coordinate]


def _file_name(name: str) -> str:
    if not name.strip() or not name.isprintable() or max(len(part.encode()) for part in name.split("/")) > 255:
        raise ValueError(f"= {name[:80]!r} is no file name; give a path relative to the case folder")
    return name


FileName = Annotated[str, AfterValidator(_file_name)]
SeriesName = Annotated[int, Field(strict=True)] | Annotated[str, Field(min_length=1)]


def _label(value: Any) -> Any:
    one = value if isinstance(value, list) else [value]
    numbers = [isinstance(v, int) and not isinstance(v, bool) and v > 0 for v in one]
    names = [isinstance(v, str) and bool(v.strip()) for v in one]
    if not one or not all(a or b for a, b in zip(numbers, names, strict=True)):
        raise ValueError(f"= {value!r} is no label; give the label's number, from 1, or the segment's name")
    return tuple(one)


Labels = Annotated[tuple[int | str, ...], BeforeValidator(_label)]
"""Numbers or segments' names; a single one may stand without brackets."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ImageFiles(_Table):
    """Paths relative to the case folder; a cone-beam CT that is not taken yet may be left out.

    *_series: UID, number or description of the series to take in a DICOM folder that holds several; HU = slope x value
    + intercept where an image is not in HU.
    """

    ct: FileName
    cbct_inflated: FileName | None = None
    cbct_deflated: FileName | None = None
    ct_series: SeriesName | None = None
    cbct_inflated_series: SeriesName | None = None
    cbct_deflated_series: SeriesName | None = None
    ct_slope: Slope | None = None
    ct_intercept: Coordinate | None = None
    cbct_inflated_slope: Slope | None = None
    cbct_inflated_intercept: Coordinate | None = None
    cbct_deflated_slope: Slope | None = None
    cbct_deflated_intercept: Coordinate | None = None

    def series(self, image: str) -> SeriesName | None:
        """What is stated of the image's series: "ct", "cbct_inflated" or "cbct_deflated"."""
        stated: SeriesName | None = getattr(self, f"{image}_series")
        return stated


class NoduleFiles(_Table):
    """A mask or a point in the CT frame, or both. label: which region of the mask, where it holds several."""

    mask: FileName | None = None
    point: FileName | None = None
    label: Labels | None = None

    @model_validator(mode="after")
    def _at_least_one(self) -> NoduleFiles:
        if self.label is not None and self.mask is None:
            raise ValueError("has a label but no mask; add the mask that it chooses from, or remove label")
        if self.label is not None and len(self.label) > 1:
            raise ValueError(f"has {len(self.label)} labels; keep one nodule per case")
        if self.mask is None and self.point is None:
            raise ValueError('names neither mask nor point; add mask = "nodule.nii.gz" or point = "nodule_ct.mrk.json"')
        return self


class Setup(_Table):
    """The operating table. gravity_cbct: direction of gravity in RAS of the CBCT, unit length."""

    gravity_cbct: Triple | None = None
    pleural_gas: PleuralGas = "air"

    @field_validator("gravity_cbct")
    @classmethod
    def _unit_length(cls, gravity: Triple | None) -> Triple | None:
        if gravity is not None:
            length = float(np.linalg.norm(gravity))
            if abs(length - 1) > GRAVITY_LENGTH_TOLERANCE:
                raise ValueError(f"has length {length:.3g}, 1 needed; give a unit vector")
        return gravity


class HintValues(_Table):
    """What a user may give by hand. spine_*: RAS mm, the same vertebra in both images; lung_label: which regions of the
    lung mask together are lung, where it holds several."""

    spine_ct: Triple | None = None
    spine_cbct_inflated: Triple | None = None
    lung_mask_ct: FileName | None = None
    lung_label: Labels | None = None
    deflated_surface: FileName | None = None

    @model_validator(mode="after")
    def _spine_in_both(self) -> HintValues:
        if (self.spine_ct is None) != (self.spine_cbct_inflated is None):
            raise ValueError(
                "names the spine in one image only; give both spine_ct and spine_cbct_inflated, or neither"
            )
        if self.lung_label is not None and self.lung_mask_ct is None:
            raise ValueError("has a lung_label but no lung_mask_ct; add the mask that it chooses from, or remove it")
        return self


class LandmarkFiles(_Table):
    """Point lists for evaluation alone."""

    ct: FileName | None = None
    cbct_inflated: FileName | None = None
    cbct_deflated: FileName | None = None


class CaseFile(_Table):
    """The whole of case.toml. side: of the operated lung, None where the images are to tell it."""

    side: Side | None = None
    images: ImageFiles
    nodule: NoduleFiles
    setup: Setup = Setup()
    hints: HintValues = HintValues()
    landmarks: LandmarkFiles = LandmarkFiles()


def read_case_file(folder: Path) -> CaseFile:
    """case.toml of a case folder. Raises CaseError when it is missing, no TOML, or has unknown or wrong keys."""
    path = folder / FILE_NAME
    with reading(path, "case file", "correct it", CaseError):
        if not path.is_file():
            raise CaseError(f"{folder} holds no {FILE_NAME}; name a case folder, or write one as the README shows.")
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # editors on Windows begin it with a mark
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise CaseError(f"{path} is not valid TOML ({error}); correct it.") from error
        return _validated(table, path)


def _validated(table: dict[str, Any], path: Path) -> CaseFile:
    try:
        return CaseFile.model_validate(table)
    except ValidationError as error:
        raise CaseError(f"{path}: {_sentence(error)}") from error


def _sentence(error: ValidationError) -> str:
    # An unknown key first: a misspelt name also shows as a missing one, and says less.
    first = min(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    names = [str(part) for part in first["loc"]]
    where = _key(names) if names else "the file"
    if first["type"] == "extra_forbidden":
        return f"{where} is an unknown key; {_known(names[:-1])} are known, so correct or remove it."
    if first["type"] == "missing":
        return f"{where} is missing; add it."
    if first["type"] == "value_error":
        return f"{where} {first['ctx']['error']}."
    got = first["input"]
    message = first["msg"][0].lower() + first["msg"][1:]
    return f"{where} = {got!r} is wrong ({message}); correct it."


def _key(names: list[str]) -> str:
    if len(names) == 1:
        return f"[{names[0]}]" if names[0] in _tables() else names[0]
    return f"[{names[0]}] {names[1]}" + "".join(f"[{index}]" for index in names[2:])


def _tables() -> dict[str, type[BaseModel]]:
    fields: dict[str, Any] = {name: info.annotation for name, info in CaseFile.model_fields.items()}
    return {name: kind for name, kind in fields.items() if isinstance(kind, type) and issubclass(kind, BaseModel)}


def _known(table: list[str]) -> str:
    model = _tables()[table[0]] if table else CaseFile
    return ", ".join(model.model_fields)
