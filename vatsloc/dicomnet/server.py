"""The storage provider: an association, a store, a release, each handed on to the store on disk."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

from pydicom.dataset import Dataset

from vatsloc.dicomnet.store import Refused, Store
from vatsloc.errors import CaseError

SOP_CLASSES = (
    "1.2.840.10008.5.1.4.1.1.2",  # CT Image
    "1.2.840.10008.5.1.4.1.1.2.1",  # Enhanced CT Image
    "1.2.840.10008.5.1.4.1.1.2.2",  # Legacy Converted Enhanced CT Image
    "1.2.840.10008.5.1.4.1.1.12.1",  # X-Ray Angiographic Image, as some C-arms store their slices
    "1.2.840.10008.5.1.4.1.1.13.1.1",  # X-Ray 3D Angiographic Image
)
"""What is taken; all else is refused before it is sent."""
MOST_ASSOCIATIONS = 32


@contextmanager
def serving(
    store: Store, port: int, title: str, allow: Sequence[str], say: Callable[[str], None], timeout_s: float
) -> Iterator[int]:
    """Serve a store in threads of its own while the block runs; gives the port, chosen by the system where it is 0.

    allow: titles of the callers that may connect, all where empty. Raises CaseError where the port cannot be opened.
    """
    from pynetdicom import AE, ALL_TRANSFER_SYNTAXES, evt

    node = AE(ae_title=title)
    node.maximum_associations = MOST_ASSOCIATIONS
    node.network_timeout = node.acse_timeout = node.dimse_timeout = timeout_s
    for sop_class in SOP_CLASSES:
        node.add_supported_context(sop_class, ALL_TRANSFER_SYNTAXES)
    node.add_supported_context("1.2.840.10008.1.1")  # verification
    node.require_calling_aet = list(allow)
    desk = _Desk(store, say)
    handlers: list[Any] = [
        (evt.EVT_DATA_SENT, confirm_the_next_at_once),
        (evt.EVT_C_STORE, desk.store_image),
        (evt.EVT_C_ECHO, lambda event: 0x0000),
        (evt.EVT_RELEASED, desk.released),
        (evt.EVT_ABORTED, desk.broken),
        (evt.EVT_CONN_CLOSE, desk.closed),
        (evt.EVT_REJECTED, desk.rejected),
    ]
    try:
        server = node.start_server(("", port), block=False, evt_handlers=handlers)
    except OSError as error:
        raise CaseError(f"port {port} cannot be opened ({error.strerror}); choose another one by --port.") from error
    assert server is not None
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        server.server_close()


class _Desk:
    """Handlers of one server. Each association gets a name, under which the store remembers what it left open."""

    def __init__(self, store: Store, say: Callable[[str], None]) -> None:
        self.store, self.say = store, say
        self._names: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
        self._numbers = count(1)
        self._lock = threading.Lock()
        self._told: set[tuple[str, str]] = set()

    def store_image(self, event: Any) -> Dataset | int:
        """Keep the image and answer; a refusal is said once for each association and reason."""
        name = self._name(event)
        try:
            self.store.receive(event.encoded_dataset(), name)
        except Refused as refused:
            if (name, str(refused)) not in self._told:
                self._told.add((name, str(refused)))
                self.say(f"image from {_caller(event)} refused: {refused}")
            answer = Dataset()
            answer.Status, answer.ErrorComment = refused.status, str(refused)[:64]
            return answer
        return 0x0000

    def released(self, event: Any) -> None:
        """The sender said goodbye: what it sent is all of it."""
        self.store.released(self._name(event))

    def broken(self, event: Any) -> None:
        """The association was aborted by either side, or ran out of time."""
        self.say(f"the association with {_caller(event)} broke off")
        self.store.ended(self._name(event))

    def closed(self, event: Any) -> None:
        """The connection is gone, after a release or without one."""
        self.store.ended(self._name(event))

    def rejected(self, event: Any) -> None:
        """Somebody was turned away."""
        self.say(f"association refused: {_caller(event)} is not among the titles of --allow")

    def _name(self, event: Any) -> str:
        # Release and close come from two threads in either order, so a name lives as long as its association.
        with self._lock:
            return self._names.setdefault(event.assoc, f"{self.store.token}-{next(self._numbers)}")


def confirm_the_next_at_once(event: Any) -> None:
    """Ask the system, after an answer was sent, to confirm what comes next as soon as it comes.

    A sender that gathers small writes (Nagle's algorithm, dcmtk's default) holds an image back until its announcement
    is confirmed, and Linux waits 40 ms with that after an answer: 20 s for a scan of 500 images. The system forgets
    the wish with the next answer.
    """
    if hasattr(socket, "TCP_QUICKACK") and (connection := event.assoc.dul.socket) is not None:
        with suppress(OSError, AttributeError):  # the connection may be gone by now
            connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)


def _caller(event: Any) -> str:
    requestor = event.assoc.requestor
    return f"{str(requestor.ae_title).strip() or '?'} at {requestor.address}"
