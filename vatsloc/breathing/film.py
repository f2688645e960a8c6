"""Pictures of a motion: the lungs from the front with arrows of how far tissue moved, state by state."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from poro.arrays import Array
from poro.breathing.elastic import caudal
from registration.volume import Volume
from vatsloc.breathing.motion import Motion

HEIGHT = 480
_ARROWS = 350
_MARGIN_MM = 25.0


def frames(motion: Motion) -> list[Array]:
    """One picture (h, w, 3) BGR per state: the lungs from the front, and arrows from the first scan's places."""
    every = np.concatenate([nodes for lung in motion.lungs for nodes in lung.states])
    lower, upper = every.min(axis=0) - _MARGIN_MM, every.max(axis=0) + _MARGIN_MM
    scale = HEIGHT / (upper[2] - lower[2])
    width = int(scale * (upper[0] - lower[0]))
    largest = max(np.linalg.norm(s - lung.mesh.points, axis=1).max() for lung in motion.lungs for s in lung.states)

    feet = caudal(motion.lungs[0].mesh)

    def pixel(points: Array) -> Array:
        # As a radiologist looks at it: head up, the patient's right on the left. Some masks are stacked feet up.
        height = upper[2] - points[:, 2] if feet < 0 else points[:, 2] - lower[2]
        return np.stack([scale * (upper[0] - points[:, 0]), scale * height], axis=1)

    pictures = []
    for n in range(motion.count):
        picture = np.full((HEIGHT, width, 3), 24, np.uint8)
        for lung in motion.lungs:
            border = lung.mesh.boundary
            here = lung.states[n]
            triangles = np.rint(pixel(here[border.nodes])[border.triangles]).astype(np.int32)
            for triangle in triangles:
                cv2.fillConvexPoly(picture, triangle, (96, 84, 72))
        for lung in motion.lungs:
            here, start = lung.states[n], lung.mesh.points
            chosen = np.linspace(0, len(start) - 1, min(_ARROWS, len(start))).astype(int)
            length = np.linalg.norm(here - start, axis=1) / max(largest, 1e-6)
            colours = cv2.applyColorMap((255 * length[chosen]).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0]
            for a, b, colour in zip(pixel(start[chosen]), pixel(here[chosen]), colours, strict=True):
                ends = [tuple(round(float(v)) for v in p) for p in (a, b)]
                cv2.arrowedLine(
                    picture, ends[0], ends[1], tuple(int(c) for c in colour), 1, cv2.LINE_AA, tipLength=0.25
                )
        text = f"state {n}: {motion.volume_ml(n):.0f} ml"
        cv2.putText(picture, text, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (230, 230, 230), 1, cv2.LINE_AA)
        _scale(picture, float(largest))
        cv2.putText(picture, "R", (8, HEIGHT // 2), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (230, 230, 230), 1, cv2.LINE_AA)
        pictures.append(picture)
    return pictures


def _scale(picture: Array, largest_mm: float) -> None:
    """Colours of the arrows by their length, drawn along the lower edge."""
    left, width = 40, picture.shape[1] - 110
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_TURBO)
    picture[HEIGHT - 18 : HEIGHT - 10, left : left + width] = cv2.resize(ramp, (width, 8))
    for text, x in (("0", left - 16), (f"{largest_mm:.0f} mm", left + width + 6)):
        cv2.putText(picture, text, (x, HEIGHT - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (230, 230, 230), 1, cv2.LINE_AA)


WINDOW_HU = (-1000.0, 300.0)
"""Black and white of a picture."""


def slice_of(volume: Volume, axis: int, at_ras: float) -> Array:
    """A plane of an image stored along R, A, S as a picture (h, w) uint8, head up, the patient's right on the left."""
    index = int(np.clip(round(volume.grid.to_ijk(np.full(3, at_ras))[axis]), 0, volume.hu.shape[axis] - 1))
    plane = np.take(volume.hu, index, axis=axis)
    spacing = np.delete(volume.grid.spacing, axis)
    low, high = WINDOW_HU
    grey = np.clip((plane - low) / (high - low), 0, 1)
    picture = (255 * grey.T[::-1, ::-1]).astype(np.uint8)
    size = int(HEIGHT * plane.shape[0] * spacing[0] / (plane.shape[1] * spacing[1])), HEIGHT
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


FRAME_MS = 120
"""How long a picture stands."""


def animated(pictures: list[Array]) -> bytes:
    """Animated WebP that runs there and back."""
    film = cv2.Animation()
    film.frames = [*pictures, *pictures[-2:0:-1]] if len(pictures) > 2 else pictures
    film.durations = [FRAME_MS] * len(film.frames)
    _, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, 80])
    return np.asarray(data).tobytes()


def as_png(picture: Array) -> bytes:
    """A picture as a PNG file."""
    return np.asarray(cv2.imencode(".png", picture)[1]).tobytes()


def as_uri(picture: Array) -> str:
    """A picture as a data address for a page."""
    data = np.asarray(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]).tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()
