"""From the scanner to the archive by the command line alone, with the real chain; minutes long."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import highdicom as hd
import numpy as np
import pydicom
import pytest
from pydicom.uid import generate_uid

from registration.volume import Volume
from tests.vatsloc import node_scene as scene
from tests.vatsloc.dicom_scene import Ids, write_series
from tests.vatsloc.test_dicom_node import free_port
from vatsloc.formats.images import read_volume
from vatsloc.formats.markups import read_points
from vatsloc.frames import flip_points, reorient

STUDIES, FRAMES = (generate_uid(), generate_uid()), (generate_uid(), generate_uid())
IMAGES = {"ct": 0, "cbct_inflated": 1, "cbct_deflated": 1}


def as_series(case: Path, folder: Path) -> dict[str, Path]:
    """The three images of a case as DICOM series of one patient, acquired one after the other."""
    made = {}
    for n, (name, study) in enumerate(IMAGES.items()):
        volume = read_volume(case / f"{name}.nii.gz")
        hu, affine = reorient(volume.hu, volume.ras_from_ijk, "LPS")
        ids = Ids("TWIN-A", "Twin^A", STUDIES[study], FRAMES[study], generate_uid(), n + 1, name, f"1{n}0000")
        made[name] = write_series(folder / name, Volume(hu, affine), ids)
    return made


@pytest.mark.study
@pytest.mark.shared
@pytest.mark.skipif(shutil.which("storescu") is None, reason="dcmtk is not installed")
def test_three_series_pushed_and_nothing_typed_come_back_as_a_segmentation_over_the_nodule(
    shared: Path, tmp_path: Path
) -> None:
    case = shared / "cases" / "twin-a"
    series = as_series(case, tmp_path / "series")
    port, archive_port = free_port(), free_port()
    command = [sys.executable, "-m", "vatsloc", "listen", "--port", str(port), "--cases", str(tmp_path / "cases")]
    command += ["--nodule", str(case / "nodule.nii.gz"), "--patient", "TWIN-A", "--preset", "fast"]
    command += ["--send", f"ARCHIVE@127.0.0.1:{archive_port}"]
    with (
        scene.archive(tmp_path / "archive", archive_port) as received,
        subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as node,
    ):
        assert node.stderr is not None
        assert "listens on port" in node.stderr.readline()
        for folder in series.values():
            assert scene.push(port, folder) == 0
        last = time.monotonic()
        said = []
        for line in node.stderr:
            said.append(line)
            if "sent to ARCHIVE" in line:
                break
        else:
            pytest.fail("".join(said))
        seconds = time.monotonic() - last
        node.send_signal(signal.SIGINT)
        assert node.wait(30) == 0
        files = {pydicom.dcmread(file).Modality: file for file in received.iterdir()}
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
    print(f"\n{seconds:.0f} s from the last slice to the SEG; its nodule is {off:.2f} mm off")
    assert off < 3.0
    lung = pixels[..., 2].astype(bool)
    assert lung[tuple(np.rint([k, j, i]).astype(int))]  # the nodule lies in the collapsed lung
    hu = np.stack([ds.pixel_array * float(ds.RescaleSlope) + float(ds.RescaleIntercept) for ds in source])
    assert np.median(hu[pixels[..., 0].astype(bool)]) > np.median(hu[lung]) + 200  # and is denser than it
