"""Pixels: grey images, two-colour blends, outlines, and their encoding as data URIs. Channels are BGR, as in OpenCV."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from registration.volume import Array, Mask, Volume
from vatsloc.formats.meshes import Surface
from vatsloc.report.data import NODULE, Nodule, Outline
from vatsloc.report.planes import Plane, ellipse, sample, section

# Lines are drawn with sub-pixel ends: OpenCV takes integers in units of 2**-SHIFT pixel.
SHIFT = 4


def grey(hu: Array, window: tuple[float, float]) -> Array:
    """Window HU to 0..255, uint8."""
    low, high = window
    return np.clip((hu - low) * (255.0 / (high - low)), 0, 255).astype(np.uint8)


def green_magenta(moving: Array, fixed: Array) -> Array:
    """Moving image in green, fixed in magenta, grey where they agree; (rows, columns) uint8 each -> BGR."""
    return np.ascontiguousarray(np.stack([fixed, moving, fixed], axis=-1))


def as_bgr(image: Array) -> Array:
    """Grey (rows, columns) to BGR (rows, columns, 3)."""
    return np.repeat(image[..., None], 3, axis=-1)


def bgr(colour: str) -> tuple[int, int, int]:
    """ "#rrggbb" as OpenCV wants it."""
    r, g, b = (int(colour[m : m + 2], 16) for m in (1, 3, 5))
    return b, g, r


def draw_outline(image: Array, plane: Plane, outline: Outline, thickness: int = 1) -> None:
    """Draw a surface's section or a mask's border on BGR pixels of the plane, in place."""
    if isinstance(outline.shape, Surface):
        _lines(image, section(outline.shape, plane), False, outline.colour, thickness)
    else:
        _lines(image, _borders(outline.shape, plane), True, outline.colour, thickness)


def draw_nodule(image: Array, plane: Plane, nodule: Nodule, thickness: int = 2) -> None:
    """Draw the 95 % ellipsoid's section, and a dot with a gapped cross where the centre is, in place."""
    if nodule.ellipsoid is not None:
        curve = ellipse(nodule.centre_ras, nodule.ellipsoid, plane)
        if curve is not None:
            _lines(image, [curve], True, NODULE, thickness)
    away = abs(float((nodule.centre_ras - plane.origin) @ plane.normal))
    if away > max(2.0, float(np.linalg.norm(plane.right))):
        return
    at = plane.to_pixels(nodule.centre_ras)
    cv2.circle(image, _fixed_point(at), 3 << (SHIFT - 1), bgr(NODULE), cv2.FILLED, cv2.LINE_AA, SHIFT)
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        arm = np.array(direction, dtype=float)
        _lines(image, [np.array([at + 9 * arm, at + 16 * arm])], False, NODULE, 1)


def jpeg(image: Array, quality: int = 82) -> str:
    """Data URI of grey or BGR pixels."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"pixels of shape {image.shape}, {image.dtype} cannot be encoded as JPEG")
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def _borders(mask: Mask, plane: Plane) -> list[Array]:
    inside = sample(Volume(mask.inside.astype(np.float32), mask.ras_from_ijk), plane, fill=0.0) > 0.5
    borders, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return [border[:, 0, :].astype(float) for border in borders]


def _lines(image: Array, lines: Array | list[Array], closed: bool, colour: str, thickness: int) -> None:
    """Lines of equal length as one array (s, p, 2), else as a list of (p, 2)."""
    if len(lines):
        scale = 1 << SHIFT
        if isinstance(lines, list):
            points = [np.rint(line * scale).astype(np.int32) for line in lines]
        else:
            points = list(np.rint(lines * scale).astype(np.int32))
        cv2.polylines(image, points, closed, bgr(colour), thickness, cv2.LINE_AA, SHIFT)


def _fixed_point(at: Array) -> tuple[int, int]:
    x, y = np.rint(at * (1 << SHIFT)).astype(int)
    return int(x), int(y)
