"""What the chart compares: variants of the method, each a few settings that differ from a preset's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import Any, cast

from registration.ffd import FfdFit, FfdSettings, register_ffd
from registration.images.resample import coarsen, resample_mask
from registration.maps.composite import CompositeTransform
from registration.maps.field import PointMap, compose
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, beyond_the_wall, masked, register_sliding
from registration.terms.gauss_newton import Stop
from registration.volume import Volume
from vatsloc.errors import CaseError
from vatsloc.study.bench.elastix import ElastixSettings, run_elastix
from vatsloc.workflow.pose import Register
from vatsloc.workflow.settings import PRESETS, Settings, settings_of

PEER_VOXEL_MM = 1.5


class Scored(Enum):
    """What of a variant is scored."""

    SPINES = "the pose of the spine, which every phase starts from"
    POSE = "the change of pose; it runs no further"
    COLLAPSE = "the pneumothorax and the chain; its change of pose is another variant's"
    ALL = "both phases and the chain"


PANELS = {
    Scored.SPINES: ("phase1", "phase2", "chain"),
    Scored.POSE: ("phase1",),
    Scored.COLLAPSE: ("phase2", "chain"),
    Scored.ALL: ("phase1", "phase2", "chain"),
}
"""Panels of the chart that show a variant."""


@dataclass(frozen=True)
class Variant:
    """says: what it is, for the reader; over: settings that differ from the preset's; register: of phase 1."""

    says: str
    scored: Scored
    over: Mapping[str, Any] = field(default_factory=dict)
    preset: str = "balanced"
    register: Register = register_sliding

    @property
    def settings(self) -> Settings:
        """All settings of its runs."""
        return settings_of(self.preset, self.over)


def plain(fixed: LungImage, moving: LungImage, settings: FfdSettings, prior: PointMap, **_given: Any) -> FfdFit:
    """Free-form deformation of all that is seen."""
    return register_ffd(fixed.volume, moving.volume, settings, fixed_mask=fixed.seen, prior=prior)


def masked_only(fixed: LungImage, moving: LungImage, settings: FfdSettings, prior: PointMap, **_given: Any) -> FfdFit:
    """The paper's: both images masked outside their lungs, compared 5 mm beyond. Ref: Alvarez 2021, section 6.1.4."""
    return register_ffd(
        masked(fixed.volume, fixed.lung),
        masked(moving.volume, moving.lung),
        settings,
        fixed_mask=beyond_the_wall(fixed),
        prior=prior,
    )


def elastix(fixed: LungImage, moving: LungImage, settings: FfdSettings, prior: RigidTransform, **_given: Any) -> FfdFit:
    """itk-elastix inside the lung mask, from the rigid pose, on voxels of 1.5 mm; its folding is not counted here."""
    image, other = coarsen(fixed.volume, PEER_VOXEL_MM), coarsen(moving.volume, PEER_VOXEL_MM)
    other = Volume(other.hu, prior.inverse().matrix @ other.ras_from_ijk)
    lung = resample_mask(fixed.seen_of(fixed.lung.inside), image.grid)
    run = run_elastix(image, other, lung, ElastixSettings(grid_mm=settings.spacing_mm))
    found: PointMap = compose(prior, run.moving_from_fixed)
    return FfdFit(cast(CompositeTransform, found), Stop.ITERATIONS, (), float("nan"), 0.0, 1.0)


_OFF = {"on": False}


def _ffd(says: str, register: Register = register_sliding, **over: float) -> Variant:
    return Variant(says, Scored.POSE, {"registration": over}, register=register)


def _model(
    says: str, residual: bool = True, edge_mm: float | None = None, keypoints: bool = True, **over: Any
) -> Variant:
    changed: dict[str, Any] = {"model": over, "residual": {"on": residual}, "keypoints": {"on": keypoints}}
    if edge_mm is not None:
        changed["mesh"] = {"model_edge_mm": edge_mm}
    return Variant(says, Scored.COLLAPSE, changed)


def _solid(edge_mm: float, finite: bool) -> Variant:
    """The model fitted to the surface and nothing else, on one mesh with one strain measure."""
    says = f"{'finite' if finite else 'linear'} strain, {edge_mm:g} mm tetrahedra, fitted to the surface alone"
    strained = {"strained_share": -1.0 if finite else 1.0}
    return Variant(
        says,
        Scored.COLLAPSE,
        {"mesh": {"model_edge_mm": edge_mm}, "leave_out": strained, "residual": _OFF, "keypoints": _OFF},
    )


# What is left on is not scored; the pose needs none of it.
_SPINE_ALONE = {"registration": _OFF, "residual": _OFF, "keypoints": _OFF, "model": {"max_steps": 1}}

VARIANTS: dict[str, Variant] = {
    "rigid": Variant("spine alone, in both phases", Scored.SPINES, _SPINE_ALONE),
    # Bending energy knows no affine map, so a stiff enough free form is one.
    "affine": _ffd("affine map of the lung after the spine", grid_mm=64.0, levels=1, bending=1e6),
    "ffd-32": _ffd("free form, 32 mm grid", grid_mm=32.0, levels=3),
    "ffd-16": _ffd("free form, 16 mm grid", grid_mm=16.0, levels=4),
    "ffd-8": _ffd("free form, 8 mm grid"),
    "ffd-plain": _ffd("free form of everything seen", plain),
    "ffd-masked": _ffd("free form of masked lungs, as in the paper", masked_only),
    "voxel-1": _ffd("free form, voxels of 1 mm", voxel_mm=1.0),
    "voxel-1.5": _ffd("free form, voxels of 1.5 mm", voxel_mm=1.5),
    "voxel-3": _ffd("free form, voxels of 3 mm", voxel_mm=3.0),
    "no-first": Variant(
        "free form, 16 mm grid, without its first registration",
        Scored.POSE,
        {"leave_out": {"first_registration_mm": inf}},
    ),
    "elastix": _ffd("itk-elastix, 16 mm grid", elastix),
    "no-pose": Variant("no change of pose", Scored.COLLAPSE, {"registration": {"on": False}}),
    "tetrahedra-12": _model("model of 12 mm tetrahedra", edge_mm=12.0),
    "tetrahedra-8": _model("model of 8 mm tetrahedra", edge_mm=8.0),
    "tetrahedra-5": _model("model of 5 mm tetrahedra", edge_mm=5.0),
    "alone": _model("model without residual registration", residual=False),
    "alone-8": _model("model of 8 mm tetrahedra without residual registration", residual=False, edge_mm=8.0),
    "regional-alone": _model(
        "model with regional parameters, not corrected, without residual registration", residual=False, correct=False
    ),
    "no-keypoints": _model("model fitted to the surface alone", keypoints=False),
    "no-keypoints-alone": _model(
        "model fitted to the surface alone, without residual registration", residual=False, keypoints=False
    ),
    "no-regional": _model("no regional parameters", regional=False),
    "no-correction": _model("no elastic correction", correct=False),
    "paper-cost": _model("the paper's cost", cost="plain"),
    "paper-cost-alone": _model(
        "the paper's cost and parameters, without residual registration", residual=False, keypoints=False, cost="plain"
    ),
    "no-hilum": _model("hilum not tracked", hilum=False),
    "no-hilum-alone": _model("hilum not tracked, without residual registration", residual=False, hilum=False),
    "no-diaphragm": _model("diaphragm held still", diaphragm=False),
    "no-diaphragm-alone": _model(
        "diaphragm held still, without residual registration", residual=False, diaphragm=False
    ),
    **{f"linear-{edge}": _solid(edge, finite=False) for edge in (12, 8, 5)},
    **{f"finite-{edge}": _solid(edge, finite=True) for edge in (12, 8, 5)},
    **{name: Variant(f"preset {name}", Scored.ALL, preset=name) for name in PRESETS},
}
"""Every variant by name. The order is that of their runs."""


def chosen_variants(names: Sequence[str] | None) -> dict[str, Variant]:
    """Variants by name, all without names. Raises CaseError for an unknown one."""
    unknown = [name for name in names or () if name not in VARIANTS]
    if unknown:
        raise CaseError(f"{', '.join(unknown)}: no such variant; choose from {', '.join(VARIANTS)}.")
    return {name: VARIANTS[name] for name in names or VARIANTS}
