"""Masks, label images and segmentations: which regions a file holds, and the one that is meant.

A label image is never taken as one region in silence: lung 1 and nodule 2 would make a nodule as large as a lung.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.volume import Array, Mask
from vatsloc.errors import InputRefused
from vatsloc.formats.raw import RawImage, Segment, checked

Label = int | str
_LISTED = 8


def union(image: RawImage) -> Mask:
    """Everything that an image marks, in any of its layers. Raises InputRefused as `region`."""
    layers, raw = _layers(image)
    inside = np.any([_marked(layer) for layer in layers], axis=0)
    return _filled(inside, raw)


def region(image: RawImage, label: Label | Sequence[Label] | None, ask: str) -> Mask:
    """The one region of an image, or those that `label` names: numbers, or segments' names as the file has them.

    Raises InputRefused where values are negative or neither labels nor shares, and where the image holds several
    regions or none that is asked for; `ask` says how to choose.
    """
    layers, raw = _layers(image)
    wanted = None if label is None else [label] if isinstance(label, int | str) else list(label)
    if not all(_whole(layer) for layer in layers):
        return _of_shares(layers, raw, wanted)
    held = _held(layers, image.segments)
    if not held:
        raise InputRefused(f"{raw.path} is an empty mask; draw the region and save it again.")
    if wanted is None:
        chosen = held
        if len(held) > 1:
            raise InputRefused(f"{raw.path} holds {len(held)} regions: {_listed(held)}; say which is meant: {ask}.")
    else:
        chosen = [_asked_for(one, held, raw.path, ask) for one in wanted]
    inside = np.zeros(layers[0].shape, dtype=bool)
    for segment, _ in chosen:
        inside |= layers[segment.layer] == segment.label
    return _filled(inside, raw)


def _layers(image: RawImage) -> tuple[list[Array], RawImage]:
    """Label images (ni, nj, nk), checked, and the first of them as an image; overlapping segments lie in several."""
    values = image.values
    layered = bool(image.segments) and values.ndim == 4
    stack = np.moveaxis(values, -1, 0) if layered else [values]
    parts = [checked(replace(image, values=layer), least_voxels=1) for layer in stack]
    if image.segments and parts[0].values.size == 1:
        raise InputRefused(f"{image.path} is a segmentation without voxels; draw the region and save it again.")
    for part in parts:
        lowest = part.values.min()
        if lowest < 0:
            raise InputRefused(
                f"{image.path} has values down to {lowest:g}, so it is no mask; write 1 inside and 0 outside."
            )
    return [part.values for part in parts], parts[0]


def _whole(values: Array) -> bool:
    return values.dtype.kind != "f" or bool((values == np.rint(values)).all())


def _marked(values: Array) -> Array:
    return values if values.dtype == bool else values >= 0.5


def _of_shares(layers: list[Array], raw: RawImage, wanted: list[Label] | None) -> Mask:
    """Region of an image that says how much of each voxel belongs to it."""
    highest = max(float(layer.max()) for layer in layers)
    if len(layers) > 1 or highest > 1 or wanted not in (None, [1]):
        raise InputRefused(
            f"{raw.path} has values up to {highest:g} that are no whole numbers, so neither labels nor shares of "
            "voxels from 0 to 1; export it as a label image without interpolation."
        )
    return _filled(layers[0] >= 0.5, raw)


def _held(layers: list[Array], named: Sequence[Segment]) -> list[tuple[Segment, int]]:
    """Segments that have voxels, and how many; labels that the file does not name have an empty name."""
    names = {(s.layer, s.label): s.name for s in named}
    found: list[tuple[Segment, int]] = []
    for n, layer in enumerate(layers):
        labels, counts = np.unique(layer[layer != 0], return_counts=True)
        for label, count in zip(labels, counts, strict=True):
            found.append((Segment(int(label), names.get((n, int(label)), ""), n), int(count)))
    return found


def _asked_for(label: Label, held: list[tuple[Segment, int]], path: Path, ask: str) -> tuple[Segment, int]:
    matches = [one for one in held if one[0].name == label]
    if isinstance(label, str) and not matches:
        matches = [one for one in held if one[0].name.casefold() == label.strip().casefold()]
    if isinstance(label, int) or (not matches and label.strip().isdecimal()):
        matches = [one for one in held if one[0].label == int(label)]
    if len(matches) == 1:
        return matches[0]
    got = f"{len(matches)} regions" if matches else "nothing"
    raise InputRefused(f"{path} holds {got} of label {label!r} among {_listed(held)}; name one of these: {ask}.")


def _listed(held: list[tuple[Segment, int]]) -> str:
    words = [f"{s.label}{f' ({s.name})' if s.name else ''} with {count} voxels" for s, count in held[:_LISTED]]
    more = len(held) - len(words)
    return ", ".join(words) + (f" and {more} more" if more else "")


def _filled(inside: Array, raw: RawImage) -> Mask:
    if not inside.any():
        raise InputRefused(f"{raw.path} is an empty mask; draw the region and save it again.")
    return Mask(np.ascontiguousarray(inside), raw.ras_from_ijk)
