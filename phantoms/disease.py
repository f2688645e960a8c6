"""Diseases of the lung's tissue: where they are, and what they do to its density in the CT."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phantoms.fields import Lattice, patches, smooth_noise, smoothstep
from phantoms.spec import Disease

Array = NDArray[Any]
EMPTY_HU = -965.0


def emphysema_of(lung: Lattice, disease: Disease, seed: int) -> Lattice:
    """Where a lung (signed distance, mm) has lost its walls: 1 there, 0 elsewhere, more towards the apex."""
    rng = np.random.default_rng([seed, 22])
    return patches(lung, disease.emphysema, 16.0, rng, 0.8 * _height(lung))


def fibrosis_of(lung: Lattice, disease: Disease, seed: int) -> Lattice:
    """Where a lung (signed distance, mm) is scarred: 1 there, 0 elsewhere, most near the pleura and the base."""
    rng = np.random.default_rng([seed, 23])
    near = np.exp(-np.maximum(-lung.values, 0) / 15)
    return patches(lung, disease.fibrosis, 18.0, rng, 2 * near - 0.5 * _height(lung))


def _height(lung: Lattice) -> Array:
    """Height on the lung's lattice in deviations from the middle."""
    z = np.broadcast_to(lung.axes[2], lung.values.shape)
    inside = z[lung.values < 0]
    return np.asarray((z - inside.mean()) / inside.std())


def diseased(parenchyma: Lattice, lung: Lattice, disease: Disease, seed: int) -> Lattice:
    """Densities (HU) of a lung's tissue with its diseases: holes with thin walls, a net of scars; none leaves it."""
    if disease == Disease():
        return parenchyma
    hu = parenchyma.values.copy()
    points = parenchyma.points()
    rng = np.random.default_rng([seed, 24])
    if disease.emphysema > 0:
        share = emphysema_of(lung, disease, seed).sample(points).reshape(hu.shape)
        hu += share * (EMPTY_HU - hu)
    if disease.fibrosis > 0:
        share = fibrosis_of(lung, disease, seed).sample(points).reshape(hu.shape)
        net = 1 - smoothstep(np.abs(smooth_noise(parenchyma, 5.0, rng)), 0.1, 0.5)
        hu += share * (110 + 420 * net)
    return parenchyma.like(ndimage.gaussian_filter(np.clip(hu, -990, 20), 0.3))
