"""case.toml: which files make a case, and what is known about it; unknown keys and wrong types are refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from vatsloc.errors import CaseError
from vatsloc.frames import Side

FILE_NAME = "case.toml"
GRAVITY_LENGTH_TOLERANCE = 0.05
"""How far from 1 the length of gravity may be; components rounded to one digit stay within it."""

PleuralGas = Literal["air", "co2"]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Coordinate, Coordinate, Coordinate]
FileName = Annotated[str, Field(min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ImageFiles(_Table):
    """Paths relative to the case folder."""

    ct: FileName
    cbct_inflated: FileName
    cbct_deflated: FileName


class NoduleFiles(_Table):
    """A mask or a point in the CT frame, or both."""

    mask: FileName | None = None
    point: FileName | None = None

    @model_validator(mode="after")
    def _at_least_one(self) -> NoduleFiles:
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
    """What a user may give by hand. spine_*: RAS mm, the same vertebra in both images."""

    spine_ct: Triple | None = None
    spine_cbct_inflated: Triple | None = None
    lung_mask_ct: FileName | None = None
    deflated_surface: FileName | None = None

    @model_validator(mode="after")
    def _spine_in_both(self) -> HintValues:
        if (self.spine_ct is None) != (self.spine_cbct_inflated is None):
            raise ValueError(
                "names the spine in one image only; give both spine_ct and spine_cbct_inflated, or neither"
            )
        return self


class LandmarkFiles(_Table):
    """Point lists for evaluation alone."""

    ct: FileName | None = None
    cbct_inflated: FileName | None = None
    cbct_deflated: FileName | None = None


class CaseFile(_Table):
    """The whole of case.toml."""

    side: Side
    images: ImageFiles
    nodule: NoduleFiles
    setup: Setup = Setup()
    hints: HintValues = HintValues()
    landmarks: LandmarkFiles = LandmarkFiles()


def read_case_file(folder: Path) -> CaseFile:
    """case.toml of a case folder. Raises CaseError when it is missing, no TOML, or has unknown or wrong keys."""
    path = folder / FILE_NAME
    if not path.is_file():
        raise CaseError(f"{folder} holds no {FILE_NAME}; name a case folder, or write one as the README shows.")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaseError(f"{path} is not valid TOML ({error}); correct it.") from error
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
