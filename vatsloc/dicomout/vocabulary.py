"""Codes that the DICOM objects are written in: the standard's where it has one, else our own scheme 99VATSLOC."""

from __future__ import annotations

from highdicom.sr import CodedConcept
from pydicom.sr.codedict import codes

SCHEME = "99VATSLOC"

NODULE = CodedConcept("27925004", "SCT", "Nodule")
LUNG = CodedConcept("39607008", "SCT", "Lung")
SIDES = {"right": CodedConcept("24028007", "SCT", "Right"), "left": CodedConcept("7771000", "SCT", "Left")}
ABNORMAL, ANATOMY, SPACE = (
    codes.cid7150.MorphologicallyAbnormalStructure,
    codes.cid7150.AnatomicalStructure,
    codes.cid7150.SpatialAndRelationalConcept,
)
FAMILY = codes.cid7162.DeformableModels
"""Of the algorithm: registration and a poroelastic model of the lung."""
MM, ML, ONE = codes.UCUM.Millimeter, CodedConcept("ml", "UCUM", "milliliter"), codes.UCUM.NoUnits
VOLUME, COMMENT = codes.SCT.Volume, CodedConcept("121106", "DCM", "Comment")
PROCEDURE = CodedConcept("77477000", "SCT", "Computed tomography")


def own(value: str, meaning: str) -> CodedConcept:
    """A concept of our own; its meaning is cut to the 64 characters that DICOM allows."""
    return CodedConcept(value, SCHEME, meaning[:64])


ELLIPSOID = own("ellipsoid95", "95 % ellipsoid of the nodule's position")
CENTRE = own("nodule_centre", "Predicted centre of the nodule")
DEPTH = own("depth", "Depth of the nodule's centre below the lung's surface")
SEMI_AXES = tuple(own(f"semi_axis_{n}", f"Semi-axis {n} of the 95 % ellipsoid") for n in (1, 2, 3))
GATES, TRUST = own("gates", "Quality gates of the run"), own("trust", "Do the quality gates let this be trusted?")
PASSED, FAILED = own("passed", "passed"), own("failed", "failed: do not trust")
