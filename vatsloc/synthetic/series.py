"""A breath of one scanned person as a folder: an image and the truth of the motion for every state."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from phantoms.fields import lattice_over
from phantoms.twin import make_breath
from phantoms.voxels import Grid, Image
from vatsloc.errors import InputRefused
from vatsloc.formats.folder import PROGRAM, whole_folder
from vatsloc.formats.nifti import write_volume
from vatsloc.imaging.lungs import Side
from vatsloc.synthetic.case import read_scan
from vatsloc.synthetic.voxels import to_volume
from vatsloc.workflow.stages import Say, Stages, quiet

SERIES_FILE = "series.json"
SPACING_MM = 2.0
LEAST_VOLUME = 0.75
POINTS = 2000


def write_series(ct: Path, side: Side, folder: Path, count: int, seed: int = 0, say: Say = quiet) -> None:
    """Breathe the lung on `side` of a chest CT through `count` states and write them to `folder`, whole or not at all.

    Files: state_000.nii.gz (2 mm, the frame of the CT), truth_000.csv (where points of the lung in the CT are in that
    state, RAS mm), series.json (volume of the lung over that in the CT, asked for and reached). Raises InputRefused.
    """
    scan = read_scan(ct, side)
    log = Stages()
    with whole_folder(folder, (SERIES_FILE,), _is_series) as partial, log.stage("series"):
        say(f"breath of {ct.name}, {side} lung, {count} states ...")
        try:
            breath, origin = make_breath(scan, side, count, LEAST_VOLUME, seed)
        except ValueError as refusal:
            raise InputRefused(f"{ct}: {refusal}.") from refusal
        corners = scan.ct.grid.to_ras(np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(scan.ct.grid.shape) - 1))
        box = lattice_over(corners.min(axis=0) - origin, corners.max(axis=0) - origin, SPACING_MM)
        affine = np.diag([SPACING_MM, SPACING_MM, SPACING_MM, 1.0])
        affine[:3, 3] = box.origin
        nx, ny, nz = box.values.shape
        samples = breath.states[0].samples
        inner = samples[breath.patient.lung.sample(samples) < -1.0]
        points = inner[np.random.default_rng([seed, 14]).permutation(len(inner))[:POINTS]]
        back = np.eye(4)
        back[:3, 3] = origin
        for n, image in enumerate(breath.images(Grid((nx, ny, nz), affine))):
            write_volume(partial / f"state_{n:03d}.nii.gz", to_volume(Image(image.hu, back @ affine)))
            rows = np.concatenate([points, breath.states[n].from_ct(points)], axis=1) + np.tile(origin, 2)
            head = "ct_x,ct_y,ct_z,state_x,state_y,state_z"
            np.savetxt(partial / f"truth_{n:03d}.csv", rows, fmt="%.3f", delimiter=",", header=head, comments="")
        reached = [float(s.lung_map.determinant(points).mean()) for s in breath.states]
        info = {"program": PROGRAM, "scan": ct.name, "side": side, "seed": seed}
        info |= {"volume": breath.volume.tolist(), "reached": reached}
        (partial / SERIES_FILE).write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
    say(f"{count} states written to {folder}: {log.seconds['series']:.0f} s, {log.peak_mb['series']:.0f} MB")


def _is_series(folder: Path) -> bool:
    return (folder / SERIES_FILE).is_file()
