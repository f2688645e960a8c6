"""Registration of chest images: numpy arrays in, numpy arrays out, points in RAS mm, intensities in HU.

Three registrations stand on top: `register_spine` (rigid), `register_ffd` (free-form deformation of a prior map) and
`register_sliding` (a lung that slides along its wall). Below them are the rooms `registration.terms` (what is
minimized), `registration.keypoints` (matching), `registration.images`, `registration.maps` and `registration.kernels`;
below all, the nouns `Volume`, `Mask` and `Correspondences`. Maps are named target first: moving_from_fixed.
"""

from registration.correspondences import Correspondences
from registration.ffd import FfdFit, FfdSettings, register_ffd
from registration.sliding import register_sliding
from registration.spine import RigidFit, register_spine
from registration.volume import Grid, Mask, Volume

__all__ = [
    "Correspondences",
    "FfdFit",
    "FfdSettings",
    "Grid",
    "Mask",
    "RigidFit",
    "Volume",
    "register_ffd",
    "register_sliding",
    "register_spine",
]
