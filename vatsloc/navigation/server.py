"""An OpenIGTLink server: whoever connects gets the latest answer at once, and each later one when it comes.

pyigtl's own server takes one client, on this machine alone, and changes signal handlers; so only its messages are used.
"""

from __future__ import annotations

import select
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from vatsloc.errors import CaseError

STEP_S = 0.2


class Link:
    """What clients are sent. port: where they connect."""

    def __init__(self) -> None:
        self.port = 0
        self._latest: tuple[int, list[bytes]] = (0, [])

    def publish(self, messages: list[bytes]) -> None:
        """Send packed messages to all clients, and to those that connect later, in place of earlier ones."""
        self._latest = (self._latest[0] + 1, messages)

    @property
    def latest(self) -> tuple[int, list[bytes]]:
        """The number of the latest publication, from 1, and its messages."""
        return self._latest


@contextmanager
def serving(port: int, host: str = "") -> Iterator[Link]:
    """Serve in threads of their own while the block runs; port 0 for any. Raises CaseError for one that is taken."""
    link = Link()
    try:
        server = _Server((host, port), _Client)
    except OSError as error:
        raise CaseError(f"port {port} cannot be opened ({error.strerror}); choose another --openigtlink.") from error
    server.link = link
    link.port = int(server.server_address[1])
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": STEP_S})
    thread.start()
    try:
        yield link
    finally:
        server.closing.set()
        server.shutdown()
        server.server_close()  # waits for the clients' threads
        thread.join()


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    link: Link

    def __init__(self, address: tuple[str, int], handler: type[socketserver.BaseRequestHandler]) -> None:
        super().__init__(address, handler)
        self.closing = threading.Event()


class _Client(socketserver.BaseRequestHandler):
    """One connection; what the client says is not listened to."""

    def handle(self) -> None:
        """Send what is new until the client leaves."""
        server, sent = self.server, 0
        assert isinstance(server, _Server)
        while not server.closing.is_set():
            number, messages = server.link.latest
            try:
                if number != sent:
                    for message in messages:
                        self.request.sendall(message)
                    sent = number
                if select.select([self.request], [], [], STEP_S)[0] and not self.request.recv(65536):
                    return
            except OSError:  # the client is gone
                return
