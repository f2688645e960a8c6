"""DICOM Segmentation of nodule, 95 % ellipsoid and collapsed lung, on the very slices of the deflated scan."""

from __future__ import annotations

import highdicom as hd
import numpy as np
from highdicom.seg import SegmentAlgorithmTypeValues, Segmentation, SegmentationTypeValues, SegmentDescription

import vatsloc.dicomout.vocabulary as say
from poro.mesh import TetMesh
from registration.volume import Array, Grid, Mask, axis_codes
from vatsloc.dicomout.finding import Finding
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.source import SourceSeries
from vatsloc.formats.folder import PROGRAM
from vatsloc.frames import reorient
from vatsloc.maps import covered

NODULE, ELLIPSOID, LUNG = "nodule", "95 % ellipsoid", "collapsed lung"
OFF_MM = 0.05
"""How far a corner of the result's grid may lie from that of the series; headers are rounded."""
SERIES_NUMBER = 9501
_COLOURS = {NODULE: (240, 228, 66), ELLIPSOID: (213, 94, 0), LUNG: (86, 180, 233)}
_TYPES = {
    NODULE: (say.ABNORMAL, say.NODULE),
    ELLIPSOID: (say.SPACE, say.ELLIPSOID),
    LUNG: (say.ANATOMY, say.LUNG),
}


def segments_on(finding: Finding, grid: Grid) -> dict[str, Array]:
    """Voxels (ni, nj, nk) of the deflated scan by segment; those without any voxel in view are left out.

    Raises InputRefused where the result was made on another grid.
    """
    found = {NODULE: _on(finding.nodule, grid)}
    if finding.semi_axes_ras is not None:
        found[ELLIPSOID] = ellipsoid_voxels(grid, finding.centre_ras, finding.semi_axes_ras)
    found[LUNG] = covered(TetMesh(finding.lung.points_ras, finding.lung.tets), grid).inside
    return {name: inside for name, inside in found.items() if inside.any()}


def ellipsoid_voxels(grid: Grid, centre_ras: Array, semi_axes_ras: Array) -> Array:
    """Voxels whose centres lie in an ellipsoid, and the one that holds its centre, however small it is."""
    inside = np.zeros(grid.shape, dtype=bool)
    centre = grid.to_ijk(centre_ras[None])[0]
    length = np.linalg.norm(semi_axes_ras, axis=1)
    reach = length.max() / grid.spacing + 1  # a box that holds it, however it is turned
    box, cut = grid.box(centre - reach, centre + reach + 1), grid.cut(centre - reach, centre + reach + 1)
    if min(box.shape) > 0:
        along = (box.points() - centre_ras) @ (semi_axes_ras / length[:, None]).T
        inside[cut] = ((along / length) ** 2).sum(axis=-1) <= 1
    nearest = np.rint(centre).astype(int)
    if ((nearest >= 0) & (nearest < grid.shape)).all():
        inside[tuple(nearest)] = True
    return inside


def segmentation(finding: Finding, source: SourceSeries) -> Segmentation:
    """The Segmentation object of a finding; overlapping segments keep their own frames.

    Raises InputRefused where the series is not that of the result, or cannot be referred to.
    """
    segments = segments_on(finding, source.grid)
    if not segments:
        raise InputRefused(f"{source.path} shows neither the nodule nor the lung of this result; give its own series.")
    stack = np.stack([inside.transpose(2, 1, 0) for inside in segments.values()], axis=-1)
    pixels = np.empty_like(stack)
    pixels[source.order] = stack  # in the order of the images, or of the frames of the one file
    algorithm = hd.AlgorithmIdentificationSequence(name=PROGRAM, family=say.FAMILY, version=finding.version)
    described = [_described(n, name, finding, algorithm) for n, name in enumerate(segments, 1)]
    what = "DO NOT TRUST: nodule, gates failed" if finding.failed else "nodule in the collapsed lung"
    try:
        seg = Segmentation(
            source_images=list(source.images),
            pixel_array=pixels.astype(np.uint8),
            segmentation_type=SegmentationTypeValues.BINARY,
            segment_descriptions=described,
            series_instance_uid=hd.UID(),
            series_number=SERIES_NUMBER,
            sop_instance_uid=hd.UID(),
            instance_number=1,
            manufacturer=PROGRAM,
            manufacturer_model_name=PROGRAM,
            software_versions=finding.version,
            device_serial_number="0",
            content_label="NODULE",
            content_description=f"{PROGRAM}: {what}",
            series_description=f"{PROGRAM}: {what}",
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputRefused(
            f"{source.path} has headers that a Segmentation cannot refer to ({' '.join(str(error).split())}); "
            "export the series again as CT slices with their whole headers."
        ) from error
    return seg


def _on(mask: Mask, grid: Grid) -> Array:
    """The mask's voxels in the order of the grid's axes."""
    inside, ras_from_ijk = reorient(mask.inside, mask.ras_from_ijk, axis_codes(grid.ras_from_ijk))
    own = Grid(inside.shape, ras_from_ijk)
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * (np.array(grid.shape) - 1)
    off = float(np.linalg.norm(own.to_ras(corners) - grid.to_ras(corners), axis=1).max())
    if own.shape != grid.shape or off > OFF_MM:
        raise InputRefused(
            f"the result was made on {' x '.join(map(str, own.shape))} voxels and the series has "
            f"{' x '.join(map(str, grid.shape))}, corners up to {off:.2f} mm apart; "
            "give the series of its deflated scan."
        )
    return np.ascontiguousarray(inside)


def _described(
    number: int, name: str, finding: Finding, algorithm: hd.AlgorithmIdentificationSequence
) -> SegmentDescription:
    category, kind = _TYPES[name]
    return SegmentDescription(
        segment_number=number,
        segment_label=f"{name} (predicted)",
        segmented_property_category=category,
        segmented_property_type=kind,
        algorithm_type=SegmentAlgorithmTypeValues.AUTOMATIC,
        algorithm_identification=algorithm,
        tracking_uid=hd.UID(),
        tracking_id=f"{PROGRAM} {name}",
        anatomic_regions=None if name == LUNG else [say.LUNG],
        display_color=hd.color.CIELabColor.from_rgb(*_COLOURS[name]),
    )
