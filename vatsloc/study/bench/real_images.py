"""A real chest's images at two breath-holds: what registration says of it where no truth is known, depth by depth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from poro.breathing.elastic import Lung
from poro.mesh import interpolate, locate, stuff
from registration.images.resample import coarsen, resample_mask
from registration.maps.field import PointMap
from registration.maps.inversion import invert_at
from registration.maps.rigid import RigidTransform
from registration.sliding import LungImage, beyond_the_wall, masked, register_sliding
from registration.volume import Array, Mask, Volume
from vatsloc.breathing.case import BreathCase
from vatsloc.breathing.lungs import Pair
from vatsloc.evaluation.evaluate import errors_by_depth
from vatsloc.evaluation.inputs import depth_below_pleura
from vatsloc.evaluation.statistics import distances, summarize
from vatsloc.imaging.cbct import Cupping, FieldOfView, PreparedCbct
from vatsloc.imaging.surface import inflated_surface
from vatsloc.maps import MeshMap
from vatsloc.study.bench.elastix import ElastixSettings, elastix_version, run_elastix
from vatsloc.workflow.pose import DEEP_MM, continued, ffd_settings
from vatsloc.workflow.refinement import Compared, Shape, prospect, refine_by_blocks
from vatsloc.workflow.settings import Settings

POINTS = 3000
AGREED_MM = 1.0
"""Tissue that registration takes there and back to within this is what mechanical predictions are held against."""
PEER_VOXEL_MM = 2.0
_WORDS = {
    "motion": "motion",
    "there_and_back": "there and back",
    "phase1": "all of phase 1",
    "elastix": "elastix off by",
}


def registered(
    case: BreathCase, pair: Pair, predictions: dict[str, Array], say: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Figures of one lung by depth below the pleura: tissue taken from inspiration to expiration and back, by the
    registration and by all of phase 1 (`phase1`), how far elastix is from the registration's way out (null where it is
    not installed), and how far predictions (nodes (n, 3) mm by name) are from that where it agrees there and back
    within `AGREED_MM`."""
    assert case.inspiration is not None
    assert case.expiration is not None
    full, rest = case.inspiration.image, case.expiration.image
    assert full is not None
    assert rest is not None
    points = tissue(pair.inspired)
    say(f"{case.name}, {pair.side} lung: there ...")
    inspired, expired = (lung_image(scan, lung) for scan, lung in ((full, pair.inspired), (rest, pair.expired)))
    exp_from_insp = moving_from_fixed(inspired, expired)
    say(f"{case.name}, {pair.side} lung: back ...")
    insp_from_exp = moving_from_fixed(expired, inspired)
    there = exp_from_insp(points)
    columns = {"there_and_back": distances(insp_from_exp(there), points), "motion": distances(there, points)}
    say(f"{case.name}, {pair.side} lung: there and back by all of phase 1 ...")
    out = change_of_state(inspired, expired, insp_from_exp)
    home = change_of_state(expired, inspired, exp_from_insp)
    columns["phase1"] = distances(home(out(points)), points)
    if elastix_version() is not None:
        say(f"{case.name}, {pair.side} lung: elastix ...")
        columns["elastix"] = distances(_peer(inspired, expired)(points), there)
    depth = depth_below_pleura(pair.lung.inspired, points)
    agreed = columns["there_and_back"] <= AGREED_MM
    return {
        "by_depth": errors_by_depth(columns, depth),
        "elastix_version": elastix_version(),
        "agreed_share": float(agreed.mean()),
        "rows": {
            name: _statistics(distances(carried(pair.lung, nodes, points[agreed]), there[agreed]))
            for name, nodes in predictions.items()
        },
    }


def tissue(lung: Mask, count: int = POINTS) -> Array:
    """Places (n, 3) RAS mm all over a lung, at most `count`."""
    voxels = np.argwhere(lung.inside)
    rng = np.random.default_rng(0)
    chosen = voxels[rng.permutation(len(voxels))[:count]]
    return lung.grid.to_ras(chosen + rng.uniform(-0.5, 0.5, chosen.shape))


def lung_image(scan: Volume, lung: Mask) -> LungImage:
    """An image with the lung in it, on its own voxels."""
    return LungImage(scan, resample_mask(lung, scan.grid))


def moving_from_fixed(fixed: LungImage, moving: LungImage) -> PointMap:
    """The map of a lung that slides on its wall, as phase 1 finds it, from where both images lie."""
    return register_sliding(fixed, moving, ffd_settings(Settings().registration)).moving_from_fixed


def change_of_state(ct: LungImage, scan: LungImage, ct_from_scan: PointMap) -> MeshMap:
    """The map of a lung from one image to another as all of phase 1 finds it, from where both images lie: their
    registration, continued elastically up to the pleura, then blocks, smoothing and the wall.
    """
    settings = Settings()
    mesh = stuff(ct.lung.inside, ct.lung.ras_from_ijk, settings.mesh.edge_mm)
    inversion = invert_at(ct_from_scan, mesh.points, mesh.points)
    settled = inversion.residual_mm < settings.gates.max_inversion_mm
    placed = mesh.points + continued(mesh, mesh, inversion.points_fixed, settled, settled).u
    shape = Shape(
        mesh,
        MeshMap(mesh, placed, RigidTransform.identity()),
        np.flatnonzero(settled & (mesh.node_depths > DEEP_MM)),
        DEEP_MM,
        inflated_surface(scan.lung, scan.volume, _all_seen(scan.volume)),
    )
    known = prospect(Compared(ct.volume, ct.lung, _as_scan(scan.volume), scan.lung), mesh, settings.refinement)
    return MeshMap(mesh, refine_by_blocks(known, shape).points, RigidTransform.identity())


def _as_scan(image: Volume) -> PreparedCbct:
    """A CT where a cone-beam CT is asked for: all of it was seen, and nothing taken away."""
    nothing = Cupping(np.zeros(1), np.zeros(1), 1.0, {}, {})
    return PreparedCbct(image, _all_seen(image), nothing)


def _all_seen(image: Volume) -> FieldOfView:
    every = Mask(np.ones(image.hu.shape, dtype=bool), image.ras_from_ijk)
    return FieldOfView(every, every, np.zeros(2), np.inf, 2)


def _peer(fixed: LungImage, moving: LungImage) -> PointMap:
    """The same by elastix, of images masked outside the lung."""
    fixed, moving = (lung_image(coarsen(of.volume, PEER_VOXEL_MM), of.lung) for of in (fixed, moving))
    images = masked(fixed.volume, fixed.lung), masked(moving.volume, moving.lung)
    return run_elastix(images[0], images[1], beyond_the_wall(fixed), ElastixSettings()).moving_from_fixed


def carried(lung: Lung, nodes: Array, points: Array) -> Array:
    """Where points (k, 3) of the inspired lung go when its nodes go to `nodes` (n, 3)."""
    return np.asarray(points + interpolate(locate(lung.inspired, points), nodes - lung.inspired.points))


def table(name: str, side: str, found: dict[str, Any]) -> list[str]:
    """Lines of text: mean / 95 % in mm by depth, then the predictions."""
    lines = [f"{name}, {side} lung, registered there and back; mean / 95 % in mm by depth below the pleura"]
    for row in found["by_depth"]:
        to = "and deeper" if row["to_mm"] is None else f"to {row['to_mm']:g} mm"
        cells = [
            f"{words} {row[key]['mean']:.2f} / {row[key]['p95']:.1f}" for key, words in _WORDS.items() if row.get(key)
        ]
        lines.append(f"  {row['from_mm']:g} {to:12s} n {row['n']:5d}   {'   '.join(cells)}")
    share = 100 * found["agreed_share"]
    lines.append(f"  predictions against it where it returns within {AGREED_MM:g} mm ({share:.0f} % of the tissue):")
    lines += [f"    {name:40s}{s['mean']:8.2f} / {s['p95']:.1f}" for name, s in found["rows"].items()]
    return lines


def _statistics(errors_mm: Array) -> dict[str, float]:
    s = summarize(errors_mm)
    return {"mean": s.mean, "p95": s.p95, "max": s.max}
