"""A whole case spoilt at random, 200 times: every run ends by one of the program's codes, with a sentence and no half
result.

VATSLOC_MUTATIONS=40:80 runs those numbers alone, so that a stopped study goes on; mutation n is the same in every run.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest

from vatsloc.cli import main
from vatsloc.results import output_files
from vatsloc.synthetic.case import write_phantom

NUMBERS = range(*(int(n) for n in os.environ.get("VATSLOC_MUTATIONS", "0:200").split(":")))
IMAGES = ("ct", "cbct_inflated", "cbct_deflated")
LIGHT = """
[registration]
voxel_mm = 4.0
levels = 2
[mesh]
edge_mm = 14.0
model_edge_mm = 20.0
[keypoints]
on = false
[residual]
on = false
[refinement]
cell_mm = 15.0
"""
THINNED = 2
"""Every second voxel along each axis, so that a run takes seconds."""
Spoil = Callable[[np.random.Generator, Path], str]
Random = np.random.Generator


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "demo"
    write_phantom("demo", folder)
    for path in [*(folder / f"{name}.nii.gz" for name in IMAGES), folder / "nodule.nii.gz"]:
        image = nib.load(path)
        affine = image.affine @ np.diag([THINNED, THINNED, THINNED, 1])
        values = np.asarray(image.dataobj)[::THINNED, ::THINNED, ::THINNED]
        _save(path, np.ascontiguousarray(values), affine)
    return folder


def _image(random: Random, folder: Path) -> tuple[Path, nib.Nifti1Image, np.ndarray]:
    path = folder / f"{random.choice(IMAGES)}.nii.gz"
    image = nib.load(path)
    return path, image, np.asarray(image.dataobj, dtype=np.float32)


def _save(path: Path, values: np.ndarray, affine: np.ndarray) -> None:
    path.unlink()
    nib.save(nib.Nifti1Image(values, affine), path)


def header(random: Random, folder: Path) -> str:
    """One field of a NIfTI header made something else."""
    path, image, values = _image(random, folder)
    made = nib.Nifti1Image(values, image.affine)
    field = str(
        random.choice(["pixdim", "srow_x", "srow_y", "srow_z", "qform_code", "sform_code", "xyzt_units", "dim"])
    )
    entry = made.header[field]
    odd = random.choice([0, -1, 2, 3, 7, 200, 1e-6, 1e6, np.nan, np.inf])
    path.unlink()
    nib.save(made, path.with_suffix(""))
    raw = bytearray(path.with_suffix("").read_bytes())
    at = {"pixdim": 76, "srow_x": 280, "srow_y": 296, "srow_z": 312, "qform_code": 252, "sform_code": 254}
    at |= {"xyzt_units": 123, "dim": 40}
    kind = np.dtype(entry.dtype)
    with np.errstate(invalid="ignore"):
        value = np.array(odd if np.isfinite(odd) or kind.kind == "f" else 9).astype(kind).tobytes()
    where = at[field] + kind.itemsize * int(random.integers(0, max(entry.size, 1)))
    raw[where : where + kind.itemsize] = value
    path.with_suffix("").write_bytes(raw)
    _rename_image(folder, path, path.with_suffix(""))
    return f"{path.name}: {field} = {odd}"


def _rename_image(folder: Path, old: Path, new: Path) -> None:
    text = (folder / "case.toml").read_text().replace(f'"{old.name}"', f'"{new.name}"')
    (folder / "case.toml").write_text(text)


def damaged(random: Random, folder: Path) -> str:
    """A file cut short, or with some of its bytes changed."""
    path = folder / f"{random.choice([*IMAGES, 'nodule'])}.nii.gz"
    raw = bytearray(path.read_bytes())
    path.unlink()
    if random.random() < 0.5:
        path.write_bytes(raw[: int(random.integers(0, len(raw)))])
        return f"{path.name}: cut short"
    for at in random.integers(0, len(raw), 20):
        raw[at] ^= 0xFF
    path.write_bytes(raw)
    return f"{path.name}: bytes changed"


def size(random: Random, folder: Path) -> str:
    """An image cropped, thinned, or with its axes taken for others."""
    path, image, values = _image(random, folder)
    affine = image.affine.copy()
    how = str(random.choice(["crop", "thin", "swap", "mirror", "one slice", "shift"]))
    if how == "crop":
        lo = [int(random.integers(0, n // 2)) for n in values.shape]
        cut = tuple(slice(a, a + int(random.integers(1, n - a + 1))) for a, n in zip(lo, values.shape, strict=True))
        values, affine[:3, 3] = values[cut], affine[:3, 3] + affine[:3, :3] @ lo
    elif how == "thin":
        step = int(random.integers(2, 12))
        values, affine[:3, :3] = values[::step, ::step, ::step], step * affine[:3, :3]
    elif how == "swap":
        values = values.transpose([int(m) for m in random.permutation(3)])
    elif how == "mirror":
        values = np.flip(values, int(random.integers(0, 3)))
    elif how == "one slice":
        values = values[:, :, : int(random.integers(1, 4))]
    else:
        affine[:3, 3] += random.normal(0, 100, 3)
    _save(path, np.ascontiguousarray(values), affine)
    return f"{path.name}: {how} {values.shape}"


def grey(random: Random, folder: Path) -> str:
    """Grey values that are not what they were."""
    path, image, v = _image(random, folder)
    options: dict[str, Callable[[], np.ndarray]] = {
        "HU + 1000": lambda: np.maximum(v + 1000, 0),
        "0 to 1": lambda: (v - v.min()) / np.ptp(v),
        "inverted": lambda: -v,
        "noise": lambda: v + random.normal(0, random.choice([100, 400, 2000]), v.shape).astype(np.float32),
        "one NaN": lambda: np.where(np.arange(v.size).reshape(v.shape) == 77, np.nan, v).astype(np.float32),
        "constant": lambda: np.full_like(v, -1000),
        "two values": lambda: np.where(v > -500, 40, -1000).astype(np.float32),
        "clipped": lambda: np.clip(v, random.choice([-1000, -500, 0]), random.choice([50, 200])),
        "black below": lambda: np.where(np.arange(v.shape[2]) < v.shape[2] * random.random(), np.float32(-1000), v),
        "times": lambda: (v * random.choice([0.01, 0.5, 2, 30])).astype(np.float32),
        "no bone": lambda: np.minimum(v, 40),
        "all lung": lambda: np.minimum(v, -800 + 0.1 * v),
        "8 bits": lambda: np.rint(255 * (np.clip(v, -1024, 1000) + 1024) / 2024).astype(np.uint8),
    }
    how = str(random.choice(list(options)))
    _save(path, options[how](), image.affine)
    return f"{path.name}: {how}"


def swapped(random: Random, folder: Path) -> str:
    """Two files in each other's place."""
    a, b = (str(name) for name in random.choice([*IMAGES, "nodule"], 2, replace=False))
    text = (folder / "case.toml").read_text()
    text = (
        text.replace(f'"{a}.nii.gz"', '"?"').replace(f'"{b}.nii.gz"', f'"{a}.nii.gz"').replace('"?"', f'"{b}.nii.gz"')
    )
    (folder / "case.toml").write_text(text)
    return f"{a} and {b} swapped"


def nodule(random: Random, folder: Path) -> str:
    """Another nodule mask."""
    path = folder / "nodule.nii.gz"
    image = nib.load(path)
    inside = np.asarray(image.dataobj) > 0
    affine = image.affine.copy()
    options: dict[str, Callable[[], np.ndarray]] = {
        "empty": lambda: np.zeros_like(inside),
        "everything": lambda: np.ones_like(inside),
        "one voxel": lambda: np.arange(inside.size).reshape(inside.shape) == np.flatnonzero(inside)[0],
        "mirrored": lambda: np.flip(inside, 0),
        "twice": lambda: inside | np.flip(inside, 0),
        "moved": lambda: np.roll(inside, [int(n) for n in random.integers(-60, 60, 3)], (0, 1, 2)),
        "noise": lambda: random.random(inside.shape) < 0.01,
        "labels": lambda: inside * 2 + np.flip(inside, 1),
        "negative": lambda: -1 * inside,
    }
    how = str(random.choice(list(options)))
    _save(path, np.asarray(options[how]()).astype(np.int16), affine)
    return f"nodule: {how}"


def toml(random: Random, folder: Path) -> str:
    """A line of case.toml left out, or a value in it made another."""
    path = folder / "case.toml"
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    at = int(random.integers(0, len(lines)))
    odd = [
        '""',
        "0",
        "-1",
        "nan",
        "inf",
        "true",
        "[]",
        '"right"',
        '"left"',
        "[0.0, 0.0, 1.0]",
        "[1e9, 0, 0]",
        '"../.."',
    ]
    if random.random() < 0.3:
        said = f"without {lines.pop(at)}"
    elif "=" in lines[at]:
        lines[at] = f"{lines[at].partition('=')[0]}= {random.choice(odd)}"
        said = lines[at]
    else:
        key = random.choice(["spine_ct", "spin", "ct_slope", "gravity_cbct", "point", "lung_mask_ct"])
        lines.insert(at + 1, f"{key} = {random.choice(odd)}")
        said = f"{lines[at]} {lines[at + 1]}"
    path.write_text("\n".join(lines) + "\n")
    return f"case.toml: {said}"


def hints(random: Random, folder: Path) -> str:
    """Help by hand that does not help."""
    path = folder / "case.toml"
    text = path.read_text()
    if random.random() < 0.5:
        a, b = (", ".join(f"{x:.1f}" for x in random.normal(0, 60, 3)) for _ in range(2))
        text += f"\n[hints]\nspine_ct = [{a}]\nspine_cbct_inflated = [{b}]\n"
        said = f"spine {a} and {b}"
    else:
        mask = str(random.choice(["truth/lung_deflated.nii.gz", "nodule.nii.gz", "ct.nii.gz"]))
        text += f'\n[hints]\nlung_mask_ct = "{mask}"\n'
        said = mask
    path.write_text(text)
    return f"hints: {said}"


KINDS: tuple[Spoil, ...] = (header, damaged, size, grey, grey, swapped, nodule, toml, hints)


def localized(case: Path, out: Path, settings: Path) -> int:
    """The exit code of `localize` by the command line."""
    settings.write_text(LIGHT)
    with pytest.raises(SystemExit) as stop:
        main(["localize", str(case), "--out", str(out), "--preset", "fast", "--settings", str(settings)])
    return int(stop.value.code or 0)


@pytest.mark.study
def test_the_case_is_answered_as_long_as_nothing_is_spoilt(whole: Path, tmp_path: Path) -> None:
    assert localized(whole, tmp_path / "result", tmp_path / "light.toml") in (0, 5)
    assert sorted(path.name for path in (tmp_path / "result").iterdir()) == sorted(output_files(True))


@pytest.mark.study
@pytest.mark.parametrize("number", NUMBERS)
def test_a_spoilt_case_ends_by_a_code_and_a_sentence_and_leaves_no_half_result(
    number: int, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(number)
    case, out = tmp_path / "case", tmp_path / "out" / "result"
    shutil.copytree(whole, case)
    kinds = random.choice(len(KINDS), size=1 if random.random() < 0.7 else 2, replace=False)
    try:
        said = "; ".join(KINDS[kind](random, case) for kind in kinds)
    except (nib.filebasedimages.ImageFileError, OSError, EOFError, ValueError) as spoilt_already:
        pytest.skip(f"spoilt so far that it cannot be spoilt again: {spoilt_already}")
    code = localized(case, out, tmp_path / "light.toml")
    told = capsys.readouterr().err
    with capsys.disabled():
        print(f"\n{number}: {said} -> {code} {told.strip().splitlines()[-1]}")
    assert "Traceback" not in told, said
    assert code in (0, 2, 3, 4, 5), said
    assert "not foreseen" not in told, f"{said}: {told}"
    if code in (0, 5):
        taken = json.loads((out / "run.json").read_text(encoding="utf-8"))["scans"]
        assert sorted(path.name for path in out.iterdir()) == sorted(output_files("cbct_inflated" in taken)), said
    else:
        assert told.strip().splitlines()[-1].startswith("vatsloc: "), said
        assert not out.exists(), said
    assert [path.name for path in out.parent.iterdir()] in ([], [out.name]) if out.parent.exists() else True, said
