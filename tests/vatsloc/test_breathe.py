"""`vatsloc breathe`: folders, dirt in masks, drivers' motion by sign and size, outputs, and who sees landmarks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import nibabel as nib
import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from poro.arrays import Array
from registration.volume import Mask, Volume
from vatsloc.breathing.case import read_breath
from vatsloc.breathing.drr import WATER_PER_MM, radiograph
from vatsloc.breathing.lungs import Pair
from vatsloc.breathing.masks import lungs_of
from vatsloc.breathing.motion import IN, OUT, LungMotion, Motion, along
from vatsloc.breathing.run import DRIVERS, breathe_case, run_driver
from vatsloc.breathing.score import score
from vatsloc.breathing.signal import quiet_breath, sampled
from vatsloc.cli import app
from vatsloc.errors import CaseError, InputRefused
from vatsloc.formats.meshes import read_vtu
from vatsloc.study.bench.poro_lung import wall_level

CENTRES = {"left": np.array([-65.0, 0.0, 0.0]), "right": np.array([65.0, 0.0, 0.0])}
SPACING, SHAPE, ORIGIN = 3.0, (85, 60, 85), np.array([-126.0, -88.0, -126.0])
SQUEEZE = np.diag([0.96, 0.94, 0.95])
BACK = np.array([0.0, -3.0, 0.0])
"""By which the squeezed lungs lie back, so that the back wall all but stays."""


def affine() -> Array:
    a = np.diag([SPACING, SPACING, SPACING, 1.0])
    a[:3, 3] = ORIGIN
    return a


def lungs(squeeze: Array | None = None, sides: tuple[str, ...] = ("left", "right")) -> Array:
    """Mask of mirrored lungs, squeezed about their own centres."""
    grid = np.stack(np.meshgrid(*(np.arange(n) * SPACING for n in SHAPE), indexing="ij"), -1) + ORIGIN
    out = np.zeros(SHAPE, bool)
    back = np.eye(3) if squeeze is None else np.linalg.inv(squeeze)
    shift = 0 if squeeze is None else BACK
    for side in sides:
        mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
        out |= wall_level((grid - CENTRES[side] - shift) @ back.T * mirror) > 0
    return out


def save(path: Path, inside: Array) -> None:
    nib.save(nib.Nifti1Image(inside.astype(np.uint8), affine()), path)


@pytest.fixture
def person(tmp_path: Path) -> Path:
    folder = tmp_path / "person"
    folder.mkdir()
    save(folder / "lungs_inspiration.nii.gz", lungs())
    save(folder / "lungs_expiration.nii.gz", lungs(SQUEEZE))
    random = np.random.default_rng(3).uniform([-30, -40, -50], [30, 40, 50], (30, 3))
    rows = np.concatenate(
        [np.hstack([x @ np.eye(3) + c, x @ SQUEEZE + c + BACK]) for c in CENTRES.values() for x in [random]]
    )
    head = "insp_x,insp_y,insp_z,exp_x,exp_y,exp_z"
    np.savetxt(folder / "landmarks_ras_mm.csv", rows, delimiter=",", header=head, comments="", fmt="%.4f")
    return folder


def dirty(kind: str) -> Array:
    clean = lungs()
    middle = np.array(SHAPE) // 2
    if kind == "joined":
        clean[middle[0] - 15 : middle[0] + 15, middle[1] : middle[1] + 4, middle[2] : middle[2] + 4] = True
    elif kind == "pieces":
        clean[:, :, middle[2] : middle[2] + 2] = False
    elif kind == "strays":
        clean[2:5, 2:5, 2:5] = True
        clean[middle[0], -6:-3, -5:] = True
    elif kind == "slices":
        clean[:, :, middle[2] - 8 :: 7] = False
    elif kind == "torn":
        clean[: middle[0], :, middle[2] + 5] = False
    return clean


@pytest.mark.parametrize("kind", ["clean", "joined", "pieces", "strays", "slices", "torn"])
def test_lungs_are_found_whatever_dirt_their_mask_has(kind: str) -> None:
    ml = SPACING**3 / 1000
    wanted = lungs(sides=("right",)).sum() * ml
    found = lungs_of(Mask(dirty(kind), affine()), "inspiration").lungs
    assert set(found) == {"left", "right"}
    for side, mask in found.items():
        size = mask.inside.sum() * mask.grid.spacing.prod() / 1000
        assert size == pytest.approx(wanted, rel=0.12)
        centre = mask.grid.to_ras(np.argwhere(mask.inside).mean(axis=0))
        assert_allclose(centre[0], CENTRES[side][0], atol=8)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_lung_alone_is_told_by_its_inner_side(side: str) -> None:
    lung = lungs(sides=(side,))
    # A heart and a hilum: a deep dent on the inner side.
    x = np.arange(SHAPE[0]) * SPACING + ORIGIN[0]
    inner = np.abs(x) < 45
    lung[np.ix_(inner, np.arange(25, 40), np.arange(20, 50))] = False
    assert set(lungs_of(Mask(lung, affine()), "inspiration").lungs) == {side}


def test_a_mask_without_a_lung_is_refused() -> None:
    nothing = np.zeros(SHAPE, bool)
    nothing[3:6, 3:6, 3:6] = True
    with pytest.raises(InputRefused, match="1 ml of lung, 100 ml needed"):
        lungs_of(Mask(nothing, affine()), "inspiration")


def test_masks_of_different_lungs_are_refused(person: Path) -> None:
    lone = lungs(SQUEEZE, sides=("left",))
    save(person / "lungs_expiration.nii.gz", lone[:, :, :])
    half = lungs(sides=("right",))
    half[np.ix_(np.abs(np.arange(SHAPE[0]) * SPACING + ORIGIN[0]) < 45, np.arange(25, 40), np.arange(20, 50))] = False
    save(person / "lungs_inspiration.nii.gz", half)
    with pytest.raises(InputRefused):
        breathe_case(person, person.parent / "out", "surface", 2, lambda _: None)
    assert not (person.parent / "out").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[mask]\ninspiration = 'a.nii.gz'\n", "mask is wrong"),
        ("[masks]\ninspiration = 'a.nii.gz'\n", "does not exist"),
        ("[signal]\nhysteresis = 2.0\n", "hysteresis is wrong"),
        ("no toml", "not valid TOML"),
        ("", "names no image and no mask"),
    ],
)
def test_a_wrong_breath_toml_is_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "breath.toml").write_text(text)
    with pytest.raises(CaseError, match=says):
        read_breath(tmp_path)


def test_surface_moves_a_squeezed_lung_and_writes_every_state(person: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    got = CliRunner().invoke(
        app, ["breathe", str(person), "--out", str(out), "--driver", "surface", "--states", "3", "--json"]
    )
    assert got.exit_code == 0, got.output
    told = json.loads(got.stdout[got.stdout.index("{") :])
    assert told["driver"] == "surface"
    assert told["direction"] == OUT
    assert len(told["states"]) == 3
    volumes = [state["volume_ml"] for state in told["states"]]
    assert volumes[2] / volumes[0] == pytest.approx(np.linalg.det(SQUEEZE), rel=0.03)
    assert volumes[0] > volumes[1] > volumes[2]
    pressures = [state["pressure_pa"] for state in told["states"]]
    assert pressures[0] == pytest.approx(0, abs=1e-9)
    assert pressures[2] < pressures[1] < 0
    assert told["landmarks"]["n"] == 60
    assert told["landmarks"]["mean"] < 0.4 * told["landmarks"]["initial_mean"]
    first, last = (read_vtu(out / f"motion_{n:03d}.vtu") for n in (0, 2))
    assert_allclose(last.points_ras - last.point_data["displacement"], first.points_ras, atol=1e-4)
    assert np.average(last.cell_data["det_f"]) == pytest.approx(volumes[2] / volumes[0], rel=0.05)
    assert {"breath.html", "breath.json", "film.webp", "arrows.png"} <= {p.name for p in out.iterdir()}


def test_no_driver_sees_a_landmark(person: Path, tmp_path: Path) -> None:
    with_marks, without = tmp_path / "a", tmp_path / "b"
    one = breathe_case(person, with_marks, "surface", 2, lambda _: None)
    (person / "landmarks_ras_mm.csv").unlink()
    two = breathe_case(person, without, "surface", 2, lambda _: None)
    assert one["landmarks"] is not None
    assert two["landmarks"] is None
    for n in range(2):
        name = f"motion_{n:03d}.vtu"
        assert (with_marks / name).read_bytes() == (without / name).read_bytes()


def test_a_hysteresis_loop_is_closed(person: Path, tmp_path: Path) -> None:
    (person / "breath.toml").write_text(
        '[masks]\ninspiration = "lungs_inspiration.nii.gz"\n[signal]\nhysteresis = 0.8\n'
    )
    out = tmp_path / "out"
    told = breathe_case(person, out, "one-scan", 5, lambda _: None)
    assert told["landmarks"] is None
    states = [read_vtu(out / f"motion_{n:03d}.vtu").points_ras for n in range(5)]
    assert_allclose(states[4], states[0], atol=1e-3)
    assert np.abs(states[3] - states[1]).max() > 0.05  # same volume, another way
    picture = cv2.imdecode(np.frombuffer((out / "arrows.png").read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    above_the_scale = picture[:-30].astype(int)
    assert (np.ptp(above_the_scale, axis=2) > 60).sum() > 200  # arrows, not the breath's end, where nothing has moved
    volumes = [state["volume_ml"] for state in told["states"]]
    assert volumes[2] == pytest.approx(volumes[0] - 500, rel=0.03)
    assert volumes[1] == pytest.approx(volumes[3], rel=0.01)


def test_states_and_drivers_out_of_range_are_refused(person: Path, tmp_path: Path) -> None:
    with pytest.raises(CaseError, match="no driver"):
        breathe_case(person, tmp_path / "o", "wind", 5, lambda _: None)
    with pytest.raises(CaseError, match="out of range"):
        breathe_case(person, tmp_path / "o", "surface", 1, lambda _: None)
    with pytest.raises(CaseError, match="regional-pressure"):
        breathe_case(person, tmp_path / "o", "surface", 2, lambda _: None, see_landmarks=True)


def test_points_move_with_the_lung_they_lie_in_and_are_scored_the_way_it_goes(person: Path) -> None:
    from tests.poro.breathing_shapes import pear

    mesh = pear()
    shift = np.array([0.0, 0.0, -7.0])
    motion = Motion("surface", IN, (LungMotion("right", mesh, (mesh.points, mesh.points + shift)),), (0.0, 0.0), 1)
    inside = mesh.points.mean(axis=0)[None]
    assert_allclose(motion.moved(inside, 1), inside + shift)
    rows = np.hstack([inside + shift + [3.0, 0, 0], inside])  # inspiration, expiration
    path = person / "few.csv"
    np.savetxt(path, rows, delimiter=",", header="a,b,c,d,e,f", comments="")
    scores = score(motion, path)
    assert scores is not None
    assert scores["mean"] == pytest.approx(3.0, abs=1e-6)
    assert scores["initial_mean"] == pytest.approx(np.hypot(7.0, 3.0))


@pytest.mark.parametrize("direction", [OUT, IN])
def test_a_signal_leads_there_and_back_by_volume(direction: str) -> None:
    from tests.poro.breathing_shapes import pear

    mesh = pear()
    end = mesh.points * (0.9 if direction == OUT else 1.1)
    states = tuple(mesh.points + s * (end - mesh.points) for s in np.linspace(0, 1, 11))
    way = Motion("surface", direction, (LungMotion("right", mesh, states),), tuple(np.linspace(0, 50, 11)), 10)
    volume = np.array([1.0, 0.4, 0.0, 0.4, 1.0]) if direction == OUT else np.array([0.0, 0.6, 1.0, 0.6, 0.0])
    breath = along(way, volume)
    assert breath.end == 2
    lung = breath.lungs[0]
    assert_allclose(lung.states[0], mesh.points, atol=1e-9)
    assert_allclose(lung.states[2], end, atol=1e-9)
    assert_allclose(lung.states[4], lung.states[0], atol=1e-9)
    assert_allclose(lung.states[3], lung.states[1], atol=1e-9)
    held = np.array([breath.volume_ml(n) for n in range(5)])
    assert_allclose((held - held.min()) / np.ptp(held), volume, atol=0.01)
    assert along(way, np.full(3, 0.5)).end is None


@pytest.mark.parametrize("driver", list(DRIVERS))
def test_registration_of_two_images_drives_every_driver(
    person: Path, driver: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def known(inspired: Volume, expired: Volume, pair: Pair, guess: Array) -> Array:
        centre = CENTRES[pair.side]
        return (pair.lung.inspired.points - centre) @ SQUEEZE + centre + BACK

    monkeypatch.setattr("vatsloc.breathing.registered.by_registration", known)
    case = read_breath(person)
    blank = Volume(np.zeros((4, 4, 4), np.float32), np.eye(4))
    scans = [replace(scan, image=blank) for scan in (case.inspiration, case.expiration) if scan is not None]
    case = replace(case, inspiration=scans[0], expiration=scans[1])
    motion = run_driver(case, driver, 3, lambda _: None)
    assert motion.registered is not None
    beside, ours = score(motion.registered, case.landmarks), score(motion, case.landmarks)
    assert beside is not None
    assert beside["mean"] < 0.2
    alone = run_driver(replace(case, masks_alone=True), driver, 3, lambda _: None)
    assert alone.registered is None
    by_masks = score(alone, case.landmarks)
    if driver != "regional-pressure":  # whose pressures may not do what is known
        assert ours is not None
        assert ours["mean"] < 0.25 * ours["initial_mean"]
        assert by_masks is not None
        assert ours["mean"] < by_masks["mean"]


@pytest.mark.parametrize("kind", ["joined", "pieces", "strays", "slices", "torn"])
def test_a_driver_answers_whatever_dirt_the_masks_have(person: Path, kind: str) -> None:
    clean = run_driver(read_breath(person), "surface", 2, lambda _: None)
    save(person / "lungs_inspiration.nii.gz", dirty(kind))
    motion = run_driver(read_breath(person), "surface", 2, lambda _: None)
    found, wanted = (score(m, person / "landmarks_ras_mm.csv") for m in (motion, clean))
    assert found is not None
    assert wanted is not None
    assert found["n"] == wanted["n"]
    assert found["mean"] < wanted["mean"] + 1.0


def test_a_quiet_breath_and_a_sampled_signal() -> None:
    assert_allclose(quiet_breath(5, True), [1, 0.5, 0, 0.5, 1], atol=1e-12)
    assert_allclose(quiet_breath(5, False), [0, 0.5, 1, 0.5, 0], atol=1e-12)
    t, volume = sampled(np.array([[0.0, 0.0], [2.0, 1.0], [4.0, 0.0]]), 5)
    assert_allclose(t, [0, 1, 2, 3, 4])
    assert_allclose(volume, [0, 0.5, 1, 0.5, 0])


@pytest.mark.parametrize("view", ["frontal", "lateral"])
def test_a_radiograph_of_water_adds_up_its_thickness_and_a_bead_appears_in_its_place(view: str) -> None:
    shape = (60, 60, 60)
    a = np.diag([3.0, 3.0, 3.0, 1.0])
    a[:3, 3] = -88.5
    hu = np.full(shape, -1000.0, np.float32)
    hu[10:50, 10:50, 10:50] = 0.0
    shot = radiograph(Volume(hu, a), view, pixels=101)
    assert shot.integrals[50, 50] == pytest.approx(120 * WATER_PER_MM, rel=0.01)
    bead = np.full(shape, -1000.0, np.float32)
    bead[44, 38, 41] = 3000.0
    place = a[:3, :3] @ np.array([44, 38, 41]) + a[:3, 3]
    shot = radiograph(Volume(bead, a), view, pixels=201)
    row, column = np.unravel_index(np.argmax(shot.integrals), shot.integrals.shape)
    assert_allclose(shot.place(place[None])[0], [column, row], atol=1.5)
    # Head up; the patient's right on the left of a frontal view, his front on the left of a lateral one.
    assert row < 100
    assert column < 100
