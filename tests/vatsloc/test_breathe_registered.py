"""What two images tell of a breath, where masks alone put the tissue wrongly and folded."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

import vatsloc.breathing.registered as module
from poro.arrays import Array
from poro.breathing.elastic import Lung
from poro.mesh.tetmesh import signed_volumes
from registration.volume import Mask, Volume
from tests.vatsloc.test_breathe import CENTRES, affine, lungs
from vatsloc.breathing.lungs import Pair, meshed
from vatsloc.breathing.registered import FAR_MM, by_registration

LIFT = np.array([0.0, -4.0, 18.0])


def test_images_mend_a_far_guess_that_is_folded() -> None:
    """A lung of blobs, squeezed and lifted; the guess is off by 3 mm and folds in places."""
    squeeze = np.diag([0.95, 0.93, 0.9])
    centre = CENTRES["right"]
    full = lungs(sides=("right",))
    rng = np.random.default_rng(1)
    texture = ndimage.gaussian_filter(rng.normal(size=full.shape), 1.2)
    hu = np.where(full, -800 + 120 * texture / texture.std(), 0.0)
    a = affine()
    back = np.linalg.inv(squeeze)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in full.shape), indexing="ij"), -1) @ a[:3, :3].T + a[:3, 3]
    ijk = ((grid - centre - LIFT) @ back.T + centre - a[:3, 3]) / np.diag(a)[:3]
    moved = ndimage.map_coordinates(hu, np.moveaxis(ijk, -1, 0), order=1, cval=0.0)
    rest = ndimage.map_coordinates(full.astype(float), np.moveaxis(ijk, -1, 0), order=1) > 0.5
    inspired, expired = Mask(full, a), Mask(rest, a)
    mesh = meshed(inspired, 14.0)
    pair = Pair("right", inspired, expired, Lung("right", mesh, meshed(expired, 14.0)), 0.0)
    truth = (mesh.points - centre) @ squeeze.T + centre + LIFT
    guess = truth + np.array([3.0, 0.0, 0.0])
    torn = rng.choice(len(guess), len(guess) // 15, replace=False)
    guess[torn] += rng.normal(0, 14, (len(torn), 3))
    assert np.linalg.norm(guess - mesh.points, axis=1).mean() > FAR_MM
    images = Volume(hu.astype(np.float32), a), Volume(moved.astype(np.float32), a)
    found = by_registration(*images, pair, guess)
    assert np.linalg.norm(found - truth, axis=1).mean() < 0.8


def test_the_registration_is_believed_up_to_the_pleura_but_where_it_folds(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mask(lungs(sides=("right",)), affine())
    mesh = meshed(full, 14.0)
    pair = Pair("right", full, full, Lung("right", mesh, mesh), 0.0)
    wavy = np.array([0.0, 0.0, 5.0])

    def at(x: Array) -> Array:
        return np.asarray(x + np.sin(x[:, :1] / 12.0) * wavy)

    blank = Volume(np.zeros(full.inside.shape, np.float32), affine())
    monkeypatch.setattr(module, "register_sliding", lambda *_: SimpleNamespace(moving_from_fixed=at))
    found = by_registration(blank, blank, pair, mesh.points)
    assert np.abs(found - at(mesh.points)).max() < 0.3
    torn = mesh.boundary.nodes[40]

    def folded(x: Array) -> Array:
        moved = at(x)
        moved[torn] += 1.5 * (x.mean(axis=0) - x[torn])
        return moved

    monkeypatch.setattr(module, "register_sliding", lambda *_: SimpleNamespace(moving_from_fixed=folded))
    assert (signed_volumes(folded(mesh.points), mesh.tets) < 0).any()
    found = by_registration(blank, blank, pair, mesh.points)
    assert (signed_volumes(found, mesh.tets) > 0).all()
