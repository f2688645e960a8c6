"""The same anatomical points in three images, matched by their labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from registration.volume import Array
from vatsloc.errors import CaseError
from vatsloc.formats.markups import PointList


@dataclass(frozen=True)
class LandmarkTriples:
    """Landmarks seen in the CT and in at least one CBCT; (n, 3) RAS mm each, NaN where an image does not show one."""

    labels: tuple[str, ...]
    ct: Array
    inflated: Array
    deflated: Array
    unmatched: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.labels)


def match(ct: PointList, inflated: PointList | None, deflated: PointList | None) -> LandmarkTriples:
    """Landmarks of three images side by side, in the CT's order. `unmatched`: labels that no pair could be made of,
    among them those of points that were never placed.

    Raises CaseError for a label used twice, and when no label of the CT occurs in either CBCT.
    """
    by_image = [_by_label(s, name) for s, name in ((ct, "CT"), (inflated, "inflated"), (deflated, "deflated"))]
    in_ct, in_inf, in_def = by_image
    labels = tuple(label for label in ct.labels if label in in_inf or label in in_def)
    if not labels:
        seen = [
            f"{name}: {_some(points)}" for name, points in zip(("CT", "inflated", "deflated"), by_image, strict=True)
        ]
        raise CaseError(
            f"no landmark label of the CT occurs in a CBCT ({'; '.join(seen)}); "
            "give the same point the same label in every file."
        )
    unplaced = [label for points in (ct, inflated, deflated) if points is not None for label in points.unplaced]
    everything = dict.fromkeys([*in_ct, *in_inf, *in_def, *unplaced])
    nowhere = np.full(3, np.nan)
    a, b, c = (np.array([points.get(label, nowhere) for label in labels]) for points in by_image)
    return LandmarkTriples(labels, a, b, c, unmatched=tuple(x for x in everything if x not in labels))


def _by_label(landmarks: PointList | None, image: str) -> dict[str, Array]:
    if landmarks is None:
        return {}
    twice = [label for label, n in Counter(landmarks.labels).items() if n > 1]
    if twice:
        raise CaseError(
            f"the {image} landmarks use the label {twice[0]!r} more than once; "
            "labels pair the images, so make them unique."
        )
    return dict(zip(landmarks.labels, np.asarray(landmarks.ras, dtype=float), strict=True))


def _some(labels: Sequence[str] | dict[str, Array]) -> str:
    names = list(labels)
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "") if names else "none"
