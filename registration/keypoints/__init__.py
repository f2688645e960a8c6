"""Keypoints of one image and where another shows them.

`match_keypoints` finds the most distinctive voxels of two roughly aligned images by block matching, there and back.
`propagate_matches` goes on from such matches to keypoints next to them, whose blocks are warped by the local affine
motion, as long as neighbours agree. `in_groups` tells apart what was looked for widely: right matches move in large
groups.
"""

from registration.keypoints.groups import GroupSettings, in_groups
from registration.keypoints.matching import MatchSettings, detect_keypoints, match_keypoints
from registration.keypoints.propagation import PropagationSettings, propagate_matches

__all__ = [
    "GroupSettings",
    "MatchSettings",
    "PropagationSettings",
    "detect_keypoints",
    "in_groups",
    "match_keypoints",
    "propagate_matches",
]
