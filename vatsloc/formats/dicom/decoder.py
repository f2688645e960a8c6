"""Decode the pixels of DICOM files, one after the other; run as a program, it does so in a process of its own.

GDCM aborts, or reads where it must not, at a damaged stream: that ends this process, and not the run. It reads a JSON
list of files from stdin, and writes for each a line of JSON (bytes, dtype, shape; or error) and then the pixels. It is
run by its path and imports nothing of this program, so that it starts quickly.
"""

from __future__ import annotations

import json
import signal
import sys
from typing import Any

import numpy as np
import pydicom
from pydicom.pixels.decoders.base import get_decoder

PLUGINS = {"1.2.840.10008.1.2.5": "pydicom"}
"""By transfer syntax; GDCM for all other compressed ones, whatever else is installed, so that results do not differ."""
LIMIT_S = 300
"""Computing time, far more than any file takes; a decoder that hangs at a damaged stream is ended."""


def decode(dataset: pydicom.Dataset) -> np.ndarray[Any, Any]:
    """Pixels as stored, (rows, columns) or (frames, rows, columns), without any correction of unused bits."""
    syntax = dataset.file_meta.TransferSyntaxUID
    plugin = PLUGINS.get(str(syntax), "gdcm") if syntax.is_encapsulated else ""
    options: Any = {"correct_unused_bits": False}  # pydicom's hints name it in one place of two
    array, _ = get_decoder(syntax).as_array(dataset, raw=True, decoding_plugin=plugin, **options)
    return array


def main() -> None:
    """Answer on stdout for each file named on stdin."""
    out = sys.stdout.buffer
    for file in json.load(sys.stdin):
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
        try:
            pixels = np.ascontiguousarray(decode(pydicom.dcmread(file)))
            told = {"bytes": pixels.nbytes, "dtype": pixels.dtype.str, "shape": pixels.shape}
        except Exception as error:
            pixels = np.empty(0)
            told = {"error": str(error) or type(error).__name__}
        out.write(json.dumps(told).encode() + b"\n")
        out.write(pixels.tobytes())
        out.flush()


if __name__ == "__main__":
    main()
