"""What a scanner would see in every state: CT volumes, displacement fields and radiographs of the moving body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from poro.arrays import Array
from poro.breathing.body import Body, body, border_motion, network
from poro.mesh import TetMesh, locate, stuff
from poro.mesh.tetmesh import signed_volumes
from registration.images.interpolate import interpolate
from registration.images.resample import coarsen, resample
from registration.maps.field import DisplacementField
from registration.maps.rigid import RigidTransform
from registration.volume import Grid, Volume, axis_codes
from vatsloc.breathing.case import BreathCase, Tumour
from vatsloc.breathing.drr import VIEWS, Radiograph, radiograph
from vatsloc.breathing.film import as_png, slice_of
from vatsloc.breathing.motion import OUT, Motion
from vatsloc.breathing.page import Strip
from vatsloc.errors import InputRefused, VatslocError
from vatsloc.formats.fields import write_field
from vatsloc.formats.nifti import write_volume
from vatsloc.frames import flip_points, reorient
from vatsloc.imaging.spine import segment_spine
from vatsloc.maps import MeshMap, covered, sampled

FIELD_MM, BODY_MM, EDGE_MM, DRR_MM = 4.0, 5.0, 24.0, 2.5
"""Voxels of fields, of the body's mask and of what radiographs are made of; edges of the body's tetrahedra."""
TUMOUR_HU = 40.0
CAPTIONS = {
    "coronal": "CT, coronal",
    "sagittal": "CT, sagittal",
    "frontal": "Radiograph, frontal",
    "lateral": "Radiograph, lateral",
}
BODY_HU = -500.0


@dataclass(frozen=True)
class Followed:
    """The body of a case, and its comparison. nodes: of its mesh in every state."""

    body: Body
    nodes: tuple[Array, ...]
    table: dict[str, Any]


def write_images(
    folder: Path, case: BreathCase, motion: Motion, say: Callable[[str], None]
) -> tuple[list[Strip], dict[str, Any]]:
    """CT, field and radiographs of every state; pictures for the page and what to add to the JSON. Nothing without an
    image of the scan that the motion starts from.
    """
    scan = case.inspiration if motion.direction == OUT else case.expiration
    if scan is None or scan.image is None:
        return [], {}
    axes = axis_codes(scan.image.ras_from_ijk)
    hu, affine = reorient(scan.image.hu, scan.image.ras_from_ijk, "RAS")
    ct = Volume(np.ascontiguousarray(hu), affine)
    if case.tumour is not None:
        _refuse_outside(case.tumour, motion)
        ct = _with_tumour(ct, case.tumour)
    say("the rest of the body follows ...")
    followed = follow(ct, motion)
    grid = ct.grid.with_spacing(np.maximum(FIELD_MM, ct.grid.spacing))
    middle = np.concatenate([lung.mesh.points for lung in motion.lungs]).mean(axis=0)
    views: dict[str, list[Array]] = {"coronal": [], "sagittal": [], **{view: [] for view in VIEWS}}
    centres = []
    for n in range(motion.count):
        say(f"image of state {n} ...")
        back, density = _to_the_scan(motion, followed, grid, n)
        warped = _warped(ct, back, density)
        write_volume(folder / f"ct_{n:03d}.nii.gz", warped, axes)
        write_field(
            folder / f"from-scan_to-state{n:03d}_mode-points_xfm.nii.gz", _to_the_state(motion, followed, grid, n), axes
        )
        views["coronal"].append(slice_of(warped, 1, middle[1]))
        views["sagittal"].append(slice_of(warped, 0, motion.lungs[0].mesh.points[:, 0].mean()))
        ball = None if case.tumour is None else motion.moved(_ball(case.tumour), n)
        if ball is not None:
            centres.append(flip_points(ball.mean(axis=0)).tolist())
        small = coarsen(warped, DRR_MM)
        for view in VIEWS:
            shot = radiograph(small, view)
            np.save(folder / f"drr_{view}_{n:03d}.npy", shot.stored())
            picture = _outlined(shot, ball)
            (folder / f"drr_{view}_{n:03d}.png").write_bytes(as_png(picture))
            views[view].append(picture)
    details: dict[str, Any] = {"body": followed.table}
    if centres:
        details["tumour_lps"] = centres
    return [Strip(CAPTIONS[name], pictures) for name, pictures in views.items()], details


def follow(ct: Volume, motion: Motion) -> Followed:
    """The body's nodes in every state by the elastic body, and the paper's network beside it at the farthest state."""
    coarse = coarsen(ct, BODY_MM)
    lungs = np.zeros(coarse.grid.shape, bool)
    for lung in motion.lungs:
        lungs |= covered(lung.mesh, coarse.grid).inside
    inside = _body_mask(coarse) & ~lungs
    mesh = stuff(inside, coarse.ras_from_ijk, EDGE_MM)
    hu = interpolate(np.ascontiguousarray(ndimage.uniform_filter(coarse.hu, 3)), coarse.grid, mesh.points, -1000.0)
    borders = [lung.mesh.boundary for lung in motion.lungs]
    scene = body(mesh, hu, _spine(ct, mesh), borders)

    def wanted(n: int) -> Array:
        moved = [lung.states[n][b.nodes] - b.points for lung, b in zip(motion.lungs, borders, strict=True)]
        return border_motion(borders, moved, mesh.points[scene.near])

    began = perf_counter()
    nodes = tuple(mesh.points + scene.follow(wanted(n)) for n in range(motion.count))
    elastic_s = (perf_counter() - began) / motion.count
    far = int(np.argmax([np.abs(states - mesh.points).max() for states in nodes]))
    began = perf_counter()
    by_springs, steps = network(scene, wanted(far))
    springs_s = perf_counter() - began
    elastic = nodes[far] - mesh.points
    table = {
        "state": far,
        "elastic": _quality(scene, elastic, elastic_s),
        "mass_spring_damper": {**_quality(scene, by_springs, springs_s), "steps": steps},
        "difference_mm": float(np.linalg.norm(elastic - by_springs, axis=1).mean()),
    }
    return Followed(scene, nodes, table)


def _quality(scene: Body, u: Array, seconds: float) -> dict[str, float]:
    after = signed_volumes(scene.mesh.points + u, scene.mesh.tets) / scene.mesh.volumes
    bone = scene.hu > 200
    return {
        "seconds": seconds,
        "inverted_share": float((after <= 0).mean()),
        "bone_moves_mm": float(np.linalg.norm(u[bone], axis=1).mean()) if bone.any() else 0.0,
        "volume_change_sd": float(after.std()),
        "mean_mm": float(np.linalg.norm(u, axis=1).mean()),
    }


def _to_the_scan(motion: Motion, followed: Followed, grid: Grid, n: int) -> tuple[DisplacementField, Array]:
    """Where in the scan to look for each voxel of a state, and how much denser lung is there."""
    identity = RigidTransform.identity()
    around = TetMesh(followed.nodes[n], followed.body.mesh.tets)
    vectors = np.array(sampled(MeshMap(around, followed.body.mesh.points, identity), grid).vectors)
    density = np.ones(grid.shape, np.float32)
    for lung in motion.lungs:
        there = TetMesh(lung.states[n], lung.mesh.tets)
        inner = sampled(MeshMap(there, lung.mesh.points, identity), grid, beyond_mm=0.0)
        inside = covered(there, grid).inside
        vectors[inside] = inner.vectors[inside]
        weight = np.bincount(lung.mesh.tets.ravel(), np.repeat(there.volumes, 4), len(there.points))
        ratio = np.bincount(lung.mesh.tets.ravel(), np.repeat(lung.mesh.volumes, 4), len(there.points)) / weight
        # A point that moves to (r, r, r) carries a number as a map carries a place.
        carrier = MeshMap(there, there.points + ratio[:, None], identity)
        density[inside] = sampled(carrier, grid, beyond_mm=0.0).vectors[inside][:, 0]
    return DisplacementField(vectors.astype(np.float32), grid.ras_from_ijk), density


def _to_the_state(motion: Motion, followed: Followed, grid: Grid, n: int) -> DisplacementField:
    """Where every voxel of the scan is in a state."""
    identity = RigidTransform.identity()
    vectors = np.array(sampled(MeshMap(followed.body.mesh, followed.nodes[n], identity), grid).vectors)
    for lung in motion.lungs:
        inner = sampled(MeshMap(lung.mesh, lung.states[n], identity), grid, beyond_mm=0.0)
        inside = covered(lung.mesh, grid).inside
        vectors[inside] = inner.vectors[inside]
    return DisplacementField(vectors.astype(np.float32), grid.ras_from_ijk)


def _warped(ct: Volume, back: DisplacementField, density: Array) -> Volume:
    """The scan in a state; lung keeps its mass: HU + 1000 follows the density."""
    warped = resample(ct, ct.grid, _within(ct.grid, back))
    if np.allclose(density, 1):
        return warped
    fine = resample(Volume(density, back.ras_from_ijk), ct.grid, fill=1.0)
    airy = warped.hu < -300  # vessels and what lies around are water, which breathing does not thin
    return replace(warped, hu=np.where(airy, (warped.hu + 1000) * fine.hu - 1000, warped.hu).astype(np.float32))


def _within(grid: Grid, back: DisplacementField) -> DisplacementField:
    """The field with what it would look for above or below the scan found in its last slice."""
    points = back.grid.points()
    ijk = grid.to_ijk(points + back.vectors)
    ijk[..., 2] = np.clip(ijk[..., 2], 0.0, grid.shape[2] - 1.0)
    return DisplacementField((grid.to_ras(ijk) - points).astype(np.float32), back.ras_from_ijk)


def _body_mask(coarse: Volume) -> Array:
    labels, _ = ndimage.label(ndimage.binary_opening(coarse.hu > BODY_HU, iterations=1))
    size = np.bincount(labels.ravel())
    size[0] = 0
    inside = labels == np.argmax(size)
    for k in range(inside.shape[2]):
        inside[:, :, k] = ndimage.binary_fill_holes(inside[:, :, k])
    return inside


def _spine(ct: Volume, mesh: TetMesh) -> Array:
    """Nodes (n,) in or beside the spine, which does not breathe; the back of the body where no spine is found."""
    try:
        mask = segment_spine(ct).mask
    except (VatslocError, ValueError):
        return np.asarray(mesh.points[:, 1] < np.quantile(mesh.points[:, 1], 0.1))
    away = ndimage.distance_transform_edt(~mask.inside, sampling=mask.grid.spacing).astype(np.float32)
    near = interpolate(np.ascontiguousarray(away), mask.grid, mesh.points, 1e3) < 8.0
    return np.asarray(near if near.sum() > 3 else mesh.points[:, 1] < np.quantile(mesh.points[:, 1], 0.1))


def _refuse_outside(tumour: Tumour, motion: Motion) -> None:
    """Raises InputRefused where a tumour touches no lung."""
    centre = np.array([tumour.centre])
    away = min(float(locate(lung.mesh, centre).distance[0]) for lung in motion.lungs)
    if away > tumour.radius_mm:
        raise InputRefused(
            f"The tumour's centre lies {away:.0f} mm outside of the lungs and its radius is {tumour.radius_mm:.0f} mm; "
            "correct centre in [tumour], RAS mm."
        )


def _with_tumour(ct: Volume, tumour: Tumour) -> Volume:
    away = np.linalg.norm(ct.grid.points() - np.array(tumour.centre), axis=-1)
    share = np.clip((tumour.radius_mm - away) / ct.grid.spacing.mean() + 0.5, 0, 1).astype(np.float32)
    return replace(ct, hu=(1 - share) * ct.hu + share * TUMOUR_HU)


def _ball(tumour: Tumour, count: int = 400) -> Array:
    """Points (count, 3) spread over the tumour's border."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + np.sqrt(5)) * k
    ring = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    return np.asarray(tumour.centre) + tumour.radius_mm * ring


def _outlined(shot: Radiograph, ball: Array | None) -> Array:
    picture = cv2.cvtColor(shot.picture(), cv2.COLOR_GRAY2BGR)
    picture = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    if ball is not None:
        hull = cv2.convexHull((2 * shot.place(ball) + 0.5).astype(np.float32))
        cv2.polylines(picture, [np.rint(hull).astype(np.int32)], True, (220, 220, 0), 1, cv2.LINE_AA)
    return np.asarray(picture)
