"""From the scanner to the archive by the command line alone, with the real chain; minutes long.

Run with -s it tells the seconds from the last slice to the Segmentation, and where the picture of it lies.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import highdicom as hd
import numpy as np
import pydicom
import pytest
from pydicom.uid import generate_uid

from registration.volume import Volume
from tests.vatsloc.dcmtk import archive, free_port, needs_dcmtk, push
from tests.vatsloc.dicom_scene import Ids, write_series
from tests.vatsloc.overlay import draw_overlay, in_hu
from vatsloc.formats.images import read_volume
from vatsloc.formats.markups import read_points
from vatsloc.frames import flip_points, reorient

STUDIES, FRAMES = (generate_uid(), generate_uid()), (generate_uid(), generate_uid())
IMAGES = {"ct": 0, "cbct_inflated": 1, "cbct_deflated": 1}
BAD = ("nothing prepared", "not from what was prepared", "no answer", "refused", "given up")


def as_series(case: Path, folder: Path) -> dict[str, Path]:
    """The three images of a case as DICOM series of one patient, acquired one after the other."""
    made = {}
    for n, (name, study) in enumerate(IMAGES.items()):
        volume = read_volume(case / f"{name}.nii.gz")
        hu, affine = reorient(volume.hu, volume.ras_from_ijk, "LPS")
        ids = Ids("TWIN-A", "Twin^A", STUDIES[study], FRAMES[study], generate_uid(), n + 1, name, f"1{n}0000")
        made[name] = write_series(folder / name, Volume(hu, affine), ids)
    return made


@dataclass
class Talk:
    """What `vatsloc listen` says while it runs."""

    process: subprocess.Popen[str]
    said: list[str] = field(default_factory=list)

    def until(self, text: str) -> None:
        """Read on until a line holds the text; a line that tells of a fault fails the test."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line)
            if any(bad in line for bad in BAD):
                break
            if text in line:
                return
        pytest.fail("".join(self.said))


@contextmanager
def listening(options: list[str]) -> Iterator[Talk]:
    """The command in a process of its own, ended by Ctrl-C."""
    command = [sys.executable, "-m", "vatsloc", "listen", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        talk = Talk(process)
        try:
            talk.until("listens on port")
            yield talk
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0


@pytest.mark.study
@pytest.mark.shared
@needs_dcmtk
def test_three_series_pushed_and_nothing_typed_come_back_as_a_segmentation_over_the_nodule(
    shared: Path, tmp_path: Path
) -> None:
    """Each series is pushed when the one before it has been prepared, as in an operating room."""
    case = shared / "cases" / "twin-a"
    series = as_series(case, tmp_path / "series")
    port, archive_port = free_port(), free_port()
    options = ["--port", str(port), "--cases", str(tmp_path / "cases"), "--nodule", str(case / "nodule.nii.gz")]
    options += ["--patient", "TWIN-A", "--send", f"ARCHIVE@127.0.0.1:{archive_port}"]
    with archive(tmp_path / "archive", archive_port) as received, listening(options) as talk:
        for name in ("ct", "cbct_inflated"):
            assert push(port, series[name]) == 0
            talk.until("prepared in")
        assert push(port, series["cbct_deflated"]) == 0
        last, load = time.monotonic(), os.getloadavg()[0]
        talk.until("sent to ARCHIVE")
        seconds = time.monotonic() - last
        files = {pydicom.dcmread(file).Modality: file for file in received.iterdir()}
    (log,) = (tmp_path / "cases").glob("*/answers/*/localize.log")
    assert "CT lungs ..." not in log.read_text()  # the CT's stages were done before
    assert "deflated surface ..." in log.read_text()
    seg = hd.seg.segread(files["SEG"])
    source = sorted(
        (pydicom.dcmread(file) for file in series["cbct_deflated"].iterdir()), key=lambda d: d.InstanceNumber
    )
    pixels = seg.get_pixels_by_source_instance(
        [str(ds.SOPInstanceUID) for ds in source], assert_missing_frames_are_empty=True
    )
    (rows, columns), first = source[0].PixelSpacing, np.array(source[0].ImagePositionPatient, dtype=float)
    step = np.array(source[1].ImagePositionPatient, dtype=float) - first
    k, j, i = np.argwhere(pixels[..., 0]).mean(axis=0)
    centre_lps = first + [i * columns, j * rows, 0] + k * step
    truth = flip_points(read_points(case / "truth" / "nodule_cbct_deflated.mrk.json").ras[0])
    off = float(np.linalg.norm(centre_lps - truth))
    hu = in_hu(source)
    picture = draw_overlay(hu, pixels, (float(np.linalg.norm(step)), rows, columns), tmp_path / "overlay.png")
    print(f"\n{''.join(talk.said)}{seconds:.0f} s from the last slice to the SEG (load {load:.1f}), ", end="")
    print(f"its nodule {off:.2f} mm off, {picture}")
    assert off < 3.0
    lung = pixels[..., 2].astype(bool)
    assert lung[tuple(np.rint([k, j, i]).astype(int))]  # the nodule lies in the collapsed lung
    assert np.median(hu[pixels[..., 0].astype(bool)]) > np.median(hu[lung]) + 200  # and is denser than it
