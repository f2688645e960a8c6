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
from vatsloc.study.chart.without_model import Select, elastic_lung, smooth_spline
from vatsloc.workflow.model_selection import select_model
from vatsloc.workflow.pose import Register
from vatsloc.workflow.settings import PRESETS, Settings, settings_of

PEER_VOXEL_MM = 1.5


class Scored(Enum):
    """What of a variant is scored."""

    SPINES = "the pose of the spine, which every phase starts from"
    POSE = "the change of pose; it runs no further"
    COLLAPSE = "the pneumothorax and the chain; its change of pose is another variant's"
    ALL = "both phases and the chain"
    CHAIN = "the chain; fewer scans than phases need were taken"


PANELS = {
    Scored.SPINES: ("phase1", "phase2", "chain", "pleura"),
    Scored.POSE: ("phase1",),
    Scored.COLLAPSE: ("phase2", "chain", "pleura"),
    Scored.ALL: ("phase1", "phase2", "chain", "pleura"),
    Scored.CHAIN: ("chain", "pleura"),
}
"""Panels of the chart that show a variant."""


@dataclass(frozen=True)
class Variant:
    """says: what it is, for the reader; over: settings that differ from the preset's; register: of phase 1; select: the
    model of phase 2; blocks: whether the collapsed lung follows small blocks of the CT; pieces: whether it may be cut;
    scans: how many are used, three of them with the inflated one, one is the CT.
    """

    says: str
    scored: Scored
    over: Mapping[str, Any] = field(default_factory=dict)
    preset: str = "balanced"
    register: Register = register_sliding
    select: Select = select_model
    blocks: bool = True
    pieces: bool = True
    scans: int = 3

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
    says: str, images: bool = True, edge_mm: float | None = None, keypoints: bool = True, **over: Any
) -> Variant:
    """images: whether residual registration and block refinement follow the model."""
    changed: dict[str, Any] = {"model": over, "residual": {"on": images}, "keypoints": {"on": keypoints}}
    if edge_mm is not None:
        changed["mesh"] = {"model_edge_mm": edge_mm}
    return Variant(says, Scored.COLLAPSE, changed, blocks=images)


def _solid(edge_mm: float, finite: bool) -> Variant:
    """The model fitted to the surface and nothing else, on one mesh with one strain measure."""
    says = f"{'finite' if finite else 'linear'} strain, {edge_mm:g} mm tetrahedra, fitted to the surface alone"
    strained = {"strained_share": -1.0 if finite else 1.0}
    return Variant(
        says,
        Scored.COLLAPSE,
        {"mesh": {"model_edge_mm": edge_mm}, "leave_out": strained, "residual": _OFF, "keypoints": _OFF},
        blocks=False,
    )


# What is left on is not scored; the pose needs none of it.
_SPINE_ALONE = {"registration": _OFF, "residual": _OFF, "keypoints": _OFF, "model": {"max_steps": 1}}
_MODEL_ALONE = "without images"
"""Neither residual registration nor blocks follow."""

VARIANTS: dict[str, Variant] = {
    "rigid": Variant("spine alone, in both phases", Scored.SPINES, _SPINE_ALONE),
    # Bending energy knows no affine map, so a stiff enough free form is one.
    "affine": _ffd("affine map of the lung after the spine", grid_mm=64.0, levels=1, bending=1e6),
    "ffd-32": _ffd("free form, 32 mm grid", grid_mm=32.0, levels=3),
    "ffd-16": _ffd("free form, 16 mm grid", grid_mm=16.0, levels=4),
    "ffd-plain": _ffd("free form of everything seen", plain),
    "ffd-masked": _ffd("free form of masked lungs, as in the paper", masked_only),
    "voxel-1": _ffd("free form, voxels of 1 mm", voxel_mm=1.0),
    "voxel-1.5": _ffd("free form, voxels of 1.5 mm", voxel_mm=1.5),
    "voxel-3": _ffd("free form, voxels of 3 mm", voxel_mm=3.0),
    "no-first": Variant(
        "phase 1 without its first registration",
        Scored.POSE,
        {"leave_out": {"first_registration_mm": inf}},
    ),
    "elastix": _ffd("itk-elastix, 16 mm grid", elastix),
    "no-pose": Variant("no change of pose", Scored.COLLAPSE, {"registration": _OFF}),
    "tetrahedra-12": _model("model of 12 mm tetrahedra", edge_mm=12.0),
    "tetrahedra-8": _model("model of 8 mm tetrahedra", edge_mm=8.0),
    "tetrahedra-5": _model("model of 5 mm tetrahedra", edge_mm=5.0),
    "alone": _model(f"model {_MODEL_ALONE}", images=False),
    "alone-8": _model(f"model of 8 mm tetrahedra {_MODEL_ALONE}", images=False, edge_mm=8.0),
    "elastic": Variant("no model: an elastic lung follows surface and keypoints", Scored.COLLAPSE, select=elastic_lung),
    "spline": Variant("no model: a smooth map through surface and keypoints", Scored.COLLAPSE, select=smooth_spline),
    "elastic-alone": Variant(
        f"no model: an elastic lung {_MODEL_ALONE}",
        Scored.COLLAPSE,
        {"residual": _OFF},
        select=elastic_lung,
        blocks=False,
    ),
    "spline-alone": Variant(
        f"no model: a smooth map {_MODEL_ALONE}",
        Scored.COLLAPSE,
        {"residual": _OFF},
        select=smooth_spline,
        blocks=False,
    ),
    "regional-alone": _model(
        f"model with regional parameters, not corrected, {_MODEL_ALONE}", images=False, correct=False
    ),
    "no-keypoints": _model("model fitted to the surface alone", keypoints=False),
    "no-keypoints-alone": _model(f"model fitted to the surface alone, {_MODEL_ALONE}", images=False, keypoints=False),
    "no-regional": _model("no regional parameters", regional=False),
    "no-correction": _model("no elastic correction", correct=False),
    "no-residual": Variant("no residual registration", Scored.COLLAPSE, {"residual": _OFF}),
    "no-blocks": Variant("no block refinement, in both phases", Scored.ALL, {"refinement": _OFF}),
    "one-piece": Variant("never cut into pieces", Scored.COLLAPSE, pieces=False),
    "paper-cost": _model("the paper's cost", cost="plain"),
    "paper-cost-alone": _model(
        f"the paper's cost and parameters, {_MODEL_ALONE}", images=False, keypoints=False, cost="plain"
    ),
    "no-hilum": _model("hilum not tracked", hilum=False),
    "no-hilum-alone": _model(f"hilum not tracked, {_MODEL_ALONE}", images=False, hilum=False),
    "no-diaphragm": _model("diaphragm held still", diaphragm=False),
    "no-diaphragm-alone": _model(f"diaphragm held still, {_MODEL_ALONE}", images=False, diaphragm=False),
    **{f"linear-{edge}": _solid(edge, finite=False) for edge in (12, 8, 5)},
    **{f"finite-{edge}": _solid(edge, finite=True) for edge in (12, 8, 5)},
    **{name: Variant(f"preset {name}", Scored.ALL, preset=name) for name in PRESETS},
    "two-scans": Variant("two scans: no inflated CBCT", Scored.CHAIN, scans=2),
    "one-scan": Variant("one scan: a forecast from the CT, put where the spine lies", Scored.CHAIN, scans=1),
}
"""Every variant by name. The order is that of their runs."""


def chosen_variants(names: Sequence[str] | None) -> dict[str, Variant]:
    """Variants by name, all without names. Raises CaseError for an unknown one."""
    unknown = [name for name in names or () if name not in VARIANTS]
    if unknown:
        raise CaseError(f"{', '.join(unknown)}: no such variant; choose from {', '.join(VARIANTS)}.")
    return {name: VARIANTS[name] for name in names or VARIANTS}
