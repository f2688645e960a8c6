"""DICOM measurement report (SR, TID 1500): position, ellipsoid, depth and gates.

Ref: DICOM PS3.16, TID 1500, 1411, 1501.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import highdicom as hd
import numpy as np
from highdicom import sr
from highdicom.coding_schemes import CodingSchemeIdentificationItem
from pydicom.dataset import Dataset

import vatsloc.dicomout.vocabulary as say
from registration.volume import Array
from vatsloc.dicomout.finding import Finding
from vatsloc.dicomout.segmentation import NODULE
from vatsloc.errors import InputRefused
from vatsloc.formats.dicom.source import SourceSeries
from vatsloc.formats.folder import PROGRAM
from vatsloc.frames import flip_points

Volumetric = sr.VolumetricROIMeasurementsAndQualitativeEvaluations
SERIES_NUMBER = 9502
MILLIMETRES = frozenset(
    ("surface", "held_out", "model_error", "ellipsoid", "nodule_in_view", "check", "check_phase1", "inversion")
)
"""Gates whose values are lengths in mm; all others are shares, correlations or counts."""


def measurement_report(finding: Finding, source: SourceSeries, seg: Dataset) -> sr.Comprehensive3DSR:
    """The report about a finding; it refers to the segmentation `seg` and to the slices of the deflated scan."""
    groups: list[Volumetric | sr.MeasurementsAndQualitativeEvaluations]
    groups = [_centre(finding, source), *_ellipsoid(finding, source), *_nodule(finding, seg), _gates(finding)]
    device = sr.ObserverContext(
        observer_type=hd.sr.CodedConcept("121007", "DCM", "Device"),
        observer_identifying_attributes=sr.DeviceObserverIdentifyingAttributes(
            uid=hd.UID(), name=PROGRAM, manufacturer_name=PROGRAM, model_name=PROGRAM, serial_number="0"
        ),
    )
    content = sr.MeasurementReport(
        observation_context=sr.ObservationContext(observer_device_context=device),
        procedure_reported=say.PROCEDURE,
        imaging_measurements=groups,
    )
    _comment(content, finding)
    scheme = CodingSchemeIdentificationItem(say.SCHEME, name=f"Codes of {PROGRAM}")
    try:
        return sr.Comprehensive3DSR(
            evidence=[*source.images, seg],
            content=content,
            series_instance_uid=hd.UID(),
            series_number=SERIES_NUMBER,
            sop_instance_uid=hd.UID(),
            instance_number=1,
            manufacturer=PROGRAM,
            is_complete=True,
            is_final=False,
            is_verified=False,
            coding_schemes=[scheme],
            series_description=f"{PROGRAM}: nodule, position and gates",
            manufacturer_model_name=PROGRAM,
            software_versions=finding.version,
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputRefused(
            f"{source.path} has headers that a report cannot refer to ({' '.join(str(error).split())}); "
            "export the series again with its whole headers."
        ) from error


def ellipsoid_ends(centre_ras: Array, semi_axes_ras: Array) -> Array:
    """Ends of the three axes (6, 3) LPS mm, the longest first, as DICOM states an ELLIPSOID."""
    ends = [centre_ras + sign * axis for axis in semi_axes_ras for sign in (-1, 1)]
    return flip_points(np.array(ends))


def _algorithm(finding: Finding) -> sr.AlgorithmIdentification:
    return sr.AlgorithmIdentification(name=PROGRAM, version=finding.version, family=say.FAMILY)


def _site(finding: Finding) -> list[sr.FindingSite]:
    return [sr.FindingSite(say.LUNG, laterality=say.SIDES[finding.side])]


def _tracked(name: str) -> sr.TrackingIdentifier:
    return sr.TrackingIdentifier(uid=hd.UID(), identifier=f"{PROGRAM} {name}")


def _surface(kind: str, points_lps: Array, source: SourceSeries) -> sr.VolumeSurface:
    series = sr.SourceSeriesForSegmentation(str(source.images[0].SeriesInstanceUID))
    return sr.VolumeSurface(kind, points_lps, source.frame_of_reference, source_series=series)


def _centre(finding: Finding, source: SourceSeries) -> Volumetric:
    """The nodule's centre as a point of the deflated scan, how deep it lies, and whether to trust it."""
    depth = [] if finding.depth_mm is None else [sr.Measurement(say.DEPTH, round(finding.depth_mm, 2), say.MM)]
    return Volumetric(
        tracking_identifier=_tracked("nodule centre"),
        referenced_volume_surface=_surface("POINT", flip_points(finding.centre_ras)[None], source),
        finding_type=say.CENTRE,
        algorithm_id=_algorithm(finding),
        finding_sites=_site(finding),
        measurements=depth,
        qualitative_evaluations=[sr.QualitativeEvaluation(say.TRUST, say.FAILED if finding.failed else say.PASSED)],
    )


def _ellipsoid(finding: Finding, source: SourceSeries) -> Sequence[Volumetric]:
    if finding.semi_axes_ras is None:
        return []
    lengths = np.linalg.norm(finding.semi_axes_ras, axis=1)
    return [
        Volumetric(
            tracking_identifier=_tracked("95 % ellipsoid"),
            referenced_volume_surface=_surface(
                "ELLIPSOID", ellipsoid_ends(finding.centre_ras, finding.semi_axes_ras), source
            ),
            finding_type=say.ELLIPSOID,
            algorithm_id=_algorithm(finding),
            finding_sites=_site(finding),
            measurements=[
                sr.Measurement(name, round(float(length), 2), say.MM)
                for name, length in zip(say.SEMI_AXES, lengths, strict=True)
            ],
        )
    ]


def _nodule(finding: Finding, seg: Dataset) -> Sequence[Volumetric]:
    """The nodule's segment and its volume; nothing where no voxel of it is in view."""
    numbers = [item.SegmentNumber for item in seg.SegmentSequence if item.SegmentLabel.startswith(NODULE)]
    if not numbers:
        return []
    ml = float(finding.nodule.inside.sum() * np.abs(np.linalg.det(finding.nodule.ras_from_ijk[:3, :3])) / 1000)
    return [
        Volumetric(
            tracking_identifier=_tracked("nodule"),
            referenced_segment=sr.ReferencedSegment.from_segmentation(seg, segment_number=numbers[0]),
            finding_type=say.NODULE,
            algorithm_id=_algorithm(finding),
            finding_sites=_site(finding),
            measurements=[sr.Measurement(say.VOLUME, round(ml, 3), say.ML)],
        )
    ]


def _gates(finding: Finding) -> sr.MeasurementsAndQualitativeEvaluations:
    """Every gate: passed or failed, its value and its limit."""
    measured, judged = [], []
    for name, gate in finding.gates.items():
        words = name.replace("_", " ")
        unit = say.MM if name in MILLIMETRES else say.ONE
        judged.append(
            sr.QualitativeEvaluation(say.own(name, f"gate {words}"), say.PASSED if gate["ok"] else say.FAILED)
        )
        for key in ("value", "limit"):
            number = gate[key]
            if number is not None and math.isfinite(number):
                measured.append(sr.Measurement(say.own(f"{name}_{key}", f"{words}, {key}"), float(number), unit))
    return sr.MeasurementsAndQualitativeEvaluations(
        tracking_identifier=_tracked("gates"),
        finding_type=say.GATES,
        algorithm_id=_algorithm(finding),
        measurements=measured,
        qualitative_evaluations=judged,
    )


def _comment(content: sr.MeasurementReport, finding: Finding) -> None:
    """Failed gates and warnings in words, at the report's root."""
    said = [f"Do not trust: {finding.gates[name]['says']}" for name in finding.failed] + list(finding.warnings)
    for sentence in said:
        item = sr.TextContentItem(
            name=say.COMMENT, value=sentence, relationship_type=sr.RelationshipTypeValues.CONTAINS
        )
        content[0].ContentSequence.append(item)
