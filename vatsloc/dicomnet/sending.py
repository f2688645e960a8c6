"""Send DICOM files to a node, such as an archive."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pydicom

from vatsloc.errors import CaseError, NoAnswer


@dataclass(frozen=True)
class Target:
    """A node. title: its application entity title."""

    host: str
    port: int
    title: str = "ANY-SCP"

    def __str__(self) -> str:
        return f"{self.title}@{self.host}:{self.port}"


def target_of(text: str) -> Target:
    """The node of [TITLE@]HOST:PORT. Raises CaseError for anything else."""
    title, _, place = text.rpartition("@")
    host, _, port = place.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536 or len(title) > 16:
        raise CaseError(
            f'--send "{text}" is no node; give HOST:PORT or TITLE@HOST:PORT, the title of 16 letters at most.'
        )
    return Target(host, int(port), title or "ANY-SCP")


def send(files: Sequence[Path], target: Target, own_title: str, timeout_s: float = 30.0) -> None:
    """Send files in one association. Raises NoAnswer where the node is not there, refuses, or answers with an error."""
    from pynetdicom import AE

    try:  # pynetdicom leaves the socket of a refused connection open
        socket.create_connection((target.host, target.port), timeout_s).close()
    except OSError as error:
        raise NoAnswer(f"{target} does not answer ({error.strerror or error}); check that it runs.") from error
    node = AE(ae_title=own_title)
    node.acse_timeout = node.dimse_timeout = node.network_timeout = node.connection_timeout = timeout_s
    datasets = [pydicom.dcmread(file) for file in files]
    for dataset in datasets:
        node.add_requested_context(dataset.SOPClassUID, dataset.file_meta.TransferSyntaxUID)
    association = node.associate(target.host, target.port, ae_title=target.title)
    if not association.is_established:
        how = "refuses the association" if association.is_rejected else "does not answer"
        raise NoAnswer(f"{target} {how}; check that it runs and knows the title {own_title}.")
    try:
        for file, dataset in zip(files, datasets, strict=True):
            try:
                status = association.send_c_store(dataset)
            except (ValueError, RuntimeError) as error:  # a context that was not accepted, or a lost connection
                raise NoAnswer(f"{target} takes no {file.name} ({error}).") from error
            code = status.get("Status")
            if code is None or (code != 0 and not 0xB000 <= code <= 0xBFFF):
                told = "no answer" if code is None else f"status 0x{code:04X}"
                raise NoAnswer(
                    f"{target} did not take {file.name} ({told} {status.get('ErrorComment', '')}".rstrip() + ")."
                )
    finally:
        association.release()
