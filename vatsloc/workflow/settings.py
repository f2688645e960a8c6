"""Settings of a run: presets, and a TOML file that overrides single values."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import reduce
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vatsloc.errors import CaseError


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RegistrationSettings(_Table):
    """Free-form deformation of phase 1. Lengths in mm; bending: weight of the bending energy, mm2; on: off leaves the
    lung to the spine, the paper's variant without change of pose.
    """

    on: bool = True
    grid_mm: float = Field(default=8.0, ge=4, le=64)
    levels: int = Field(default=5, ge=1, le=6)
    voxel_mm: float = Field(default=2.0, ge=0.5, le=8)
    window_mm: float | None = Field(default=10.0, gt=0)
    bending: float = Field(default=300.0, gt=0)


class MeshSettings(_Table):
    """Finite-element lung. edge_mm: of the tetrahedra that carry the maps; model_edge_mm: of those phase 2 is fitted
    with, coarser because its error is the model's and not the mesh's.
    """

    edge_mm: float = Field(default=8.0, ge=3, le=25)
    model_edge_mm: float = Field(default=13.0, ge=4, le=25)


class ModelSettings(_Table):
    """Phase 2. cost: "plain" is the paper's; hilum, diaphragm: its variants leave one out; regional, correct:
    refinements beyond the paper, kept where they predict held-out keypoints better.
    """

    cost: Literal["surface", "plain"] = "surface"
    hilum: bool = True
    diaphragm: bool = True
    regional: bool = True
    correct: bool = True
    hilum_radius_mm: float = Field(default=15.0, gt=0)
    max_steps: int = Field(default=30, ge=1)


class KeypointSettings(_Table):
    """Keypoints inside the lung, matched between the cone-beam CTs. Lengths in mm; reach_mm: how far off along each
    axis the model may be; sigma_mm: standard deviation of a correspondence in the fit, three quarters of it in the
    elastic correction.
    """

    on: bool = True
    voxel_mm: float = Field(default=2.0, ge=1, le=4)
    reach_mm: float = Field(default=14.0, ge=4, le=40)
    sigma_mm: float = Field(default=2.0, gt=0)


class ResidualSettings(_Table):
    """Registration of the modelled lung to the observed one. Lengths in mm; bending: mm2; keypoints: weight, 1/mm2;
    levels: one fewer where the model already follows keypoints.
    """

    on: bool = True
    grid_mm: float = Field(default=16.0, ge=6, le=64)
    levels: int = Field(default=3, ge=1, le=5)
    voxel_mm: float = Field(default=2.0, ge=0.5, le=8)
    bending: float = Field(default=300.0, gt=0)
    keypoints: float = Field(default=0.01, ge=0)
    max_disagreement_mm: float = Field(default=3.0, gt=0)


class RefinementSettings(_Table):
    """Small blocks of the CT found in both cone-beam CTs, once everything else has aligned them. cell_mm: at most one
    block per cell.
    """

    on: bool = True
    cell_mm: float = Field(default=4.0, ge=2, le=20)


class LeaveOutSettings(_Table):
    """Up to which value, measured on the scene, a part is left out.

    first_registration_mm: how far 95 % of the keypoints inside the lung moved against the spine; residual_mm: median
    misfit of a lung in one piece at held-out keypoints; strained_share: of elements beyond the range of linear strain
    (finite strain); overlap_ml: volume that two pieces share (contact between pieces). -1 keeps a part whatever is
    seen.
    """

    first_registration_mm: float = Field(default=-1.0, ge=-1)
    residual_mm: float = Field(default=2.5, ge=-1)
    strained_share: float = Field(default=0.01, ge=-1)
    overlap_ml: float = Field(default=5.0, ge=-1)


class OutputSettings(_Table):
    """What is written. field_mm: how far apart, at most, the voxels of displacement fields lie; 0 for every voxel."""

    field_mm: float = Field(default=3.0, ge=0)


class GateSettings(_Table):
    """Limits beyond which a result is marked as not to be trusted."""

    min_overlap: float = Field(default=0.40, ge=0, le=1)
    min_spine_ncc: float = 0.5
    min_spine_margin: float = 0.02
    max_folded_share: float = 0.0
    max_inversion_mm: float = 1.0
    max_inverted_elements: float = 0.01
    max_surface_mm: float = 2.5
    min_surface_points: int = 200
    max_fissure_share: float = 0.1
    min_agreement: float = 0.5
    max_model_error_mm: float = 10.0
    max_held_out_mm: float = 5.0
    max_ellipsoid_mm: float = 15.0
    max_out_of_view_mm: float = 10.0
    max_left_over_mm: float = 4.0
    min_recognized: float = 0.15


class Settings(_Table):
    """Everything that shapes a result besides its inputs."""

    registration: RegistrationSettings = RegistrationSettings()
    mesh: MeshSettings = MeshSettings()
    model: ModelSettings = ModelSettings()
    keypoints: KeypointSettings = KeypointSettings()
    residual: ResidualSettings = ResidualSettings()
    refinement: RefinementSettings = RefinementSettings()
    leave_out: LeaveOutSettings = LeaveOutSettings()
    gates: GateSettings = GateSettings()
    output: OutputSettings = OutputSettings()


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {
        "registration": {"grid_mm": 20.0, "levels": 3, "voxel_mm": 3.0},
        "mesh": {"edge_mm": 10.0, "model_edge_mm": 16.0},
        "refinement": {"cell_mm": 8.0},
    },
    "balanced": {},
    "accurate": {
        "registration": {"grid_mm": 8.0, "levels": 5, "voxel_mm": 1.5},
        "mesh": {"edge_mm": 6.0},
        "residual": {"grid_mm": 10.0, "voxel_mm": 1.5},
        "refinement": {"cell_mm": 3.5},
        "leave_out": {"residual_mm": -1.0},
    },
    "auto": {"leave_out": {"first_registration_mm": 10.0}},
}


def load_settings(preset: str, file: Path | None) -> Settings:
    """Values of a preset, overridden by those of a TOML file. Raises CaseError for unknown names and wrong values."""
    values = _preset(preset)
    if file is not None:
        try:
            values = _merged(values, tomllib.loads(file.read_text(encoding="utf-8")))
        except (FileNotFoundError, IsADirectoryError) as error:
            raise CaseError(f"{file} is not there; give a TOML file of settings.") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise CaseError(f"{file} is not valid TOML ({error}); correct it.") from error
    return _checked(values, str(file))


def settings_of(preset: str, *over: Mapping[str, Any]) -> Settings:
    """Values of a preset, overridden by tables in memory, the last first. Raises CaseError as `load_settings`."""
    return _checked(reduce(_merged, over, _preset(preset)), "settings")


def _preset(name: str) -> dict[str, Any]:
    if name not in PRESETS:
        raise CaseError(f'"{name}" is no preset; choose one of {", ".join(PRESETS)}.')
    return PRESETS[name]


def _checked(values: Mapping[str, Any], source: str) -> Settings:
    try:
        return Settings(**values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise CaseError(f"{source}: {where}: {first['msg']}; correct it.") from error


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        known = out.get(key)
        out[key] = _merged(known, value) if isinstance(known, Mapping) and isinstance(value, Mapping) else value
    return out
