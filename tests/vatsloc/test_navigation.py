"""OpenIGTLink: a client reads back nodule, ellipsoid, pose and scan, by value and in the deflated scan's frame."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyigtl
import pytest
from numpy.testing import assert_allclose
from pyigtl.messages import MessageBase

from tests.vatsloc import finding_scene as scene
from tests.vatsloc.dicom_scene import Ids, write_series
from vatsloc.cli import main
from vatsloc.errors import CaseError
from vatsloc.navigation.messages import ellipsoid_surface, messages_of
from vatsloc.navigation.server import serving


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("navigation")
    case = scene.write_case_file(folder / "case")
    write_series(case / "deflated", scene.scan(), Ids())
    return scene.write_result(folder / "result", case, scene.result())


class Client:
    """Reads messages as the protocol describes them."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), 10)
        self.socket.settimeout(10)

    def read(self) -> tuple[str, str, bytes, dict[str, Any]]:
        """Type, device name, body and header of the next message."""
        header = MessageBase.parse_header(self._exactly(MessageBase.IGTL_HEADER_SIZE))
        return header["message_type"], header["device_name"], self._exactly(header["body_size"]), header

    def _exactly(self, n: int) -> bytes:
        got = b""
        while len(got) < n:
            part = self.socket.recv(n - len(got))
            assert part, "the server closed the connection"
            got += part
        return got


@contextmanager
def connected(port: int) -> Iterator[Client]:
    client = Client(port)
    try:
        yield client
    finally:
        client.socket.close()


def received(port: int, n: int = 5) -> dict[str, Any]:
    """Messages by device name, those that pyigtl can unpack as its objects, POLYDATA as its body."""
    found: dict[str, Any] = {}
    with connected(port) as client:
        for _ in range(n):
            kind, name, body, header = client.read()
            if kind == "POLYDATA":
                found[name] = body
                continue
            found[name] = MessageBase.create_message(kind)
            found[name].unpack(header, body)
    return found


def polydata(body: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles (m, 3) by the protocol's table, which pyigtl cannot unpack."""
    n_points, *_, n_polygons, polygon_bytes, _, _, _ = (0, *struct.unpack(">10I", body[:40]))[1:]
    points = np.frombuffer(body[40 : 40 + 12 * n_points], ">f4").reshape(-1, 3)
    cells = np.frombuffer(body[40 + 12 * n_points :], ">u4").reshape(n_polygons, 4)
    assert polygon_bytes == 16 * n_polygons
    assert (cells[:, 0] == 3).all()
    return points.astype(float), cells[:, 1:].astype(int)


def test_a_client_reads_back_where_the_nodule_is_in_the_scan_s_frame(result: Path) -> None:
    with serving(0, "127.0.0.1") as link:
        link.publish(messages_of(result))
        got = received(link.port)
    assert sorted(got) == ["DeflatedFromCT", "deflated", "ellipsoid95", "nodule", "trust"]
    assert_allclose(got["nodule"].positions, [scene.NODULE], atol=1e-4)
    assert got["nodule"].names == ["nodule"]
    assert got["trust"].string == "all quality gates passed"
    data = scene.result()
    assert_allclose(
        got["DeflatedFromCT"].matrix, data.rigid_deflated_from_inflated @ data.rigid_inflated_from_ct, atol=1e-4
    )
    points, triangles = polydata(got["ellipsoid95"])
    along = (points - scene.NODULE) @ scene.ellipsoid_axes().T / scene.SEMI_AXES
    assert_allclose(np.linalg.norm(along, axis=1), 1.0, atol=1e-4)
    corners = points[triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * scene.SEMI_AXES.prod(), rel=0.03)  # closed and outward


def test_the_image_lies_where_the_scan_does(result: Path) -> None:
    with serving(0, "127.0.0.1") as link:
        link.publish(messages_of(result))
        image = received(link.port)["deflated"]
    assert image.world_coordinate_system == "ras"
    hu = image.image.transpose(2, 1, 0)
    expected = scene.scan()
    assert_allclose(hu, expected.hu, atol=0.5)
    assert_allclose(image.ijk_to_world_matrix, expected.ras_from_ijk, atol=1e-3)
    at = np.rint(np.linalg.inv(image.ijk_to_world_matrix) @ [*scene.NODULE, 1])[:3].astype(int)
    assert hu[tuple(at)] == -300  # the nodule's own grey value where the POINT says


def test_a_result_not_to_be_trusted_says_so_on_the_screen(tmp_path: Path) -> None:
    result = scene.write_result(tmp_path / "result", tmp_path / "gone", scene.result(failed=True))
    with serving(0, "127.0.0.1") as link:
        link.publish(messages_of(result))
        got = received(link.port, 4)
    assert "deflated" not in got  # its case is gone
    assert got["nodule"].names == ["nodule: DO NOT TRUST"]
    assert got["trust"].string == "DO NOT TRUST: The surface stays off the observed one."


def test_later_answers_reach_those_connected_and_those_who_come_later() -> None:
    def named(name: str) -> list[bytes]:
        return [pyigtl.StringMessage(name, device_name=name).pack()]

    with serving(0, "127.0.0.1") as link, connected(link.port) as early, connected(link.port) as other:
        link.publish(named("first"))
        assert [client.read()[1] for client in (early, other)] == ["first", "first"]
        other.socket.close()  # one that leaves disturbs nobody
        link.publish(named("second"))
        assert early.read()[1] == "second"
        with connected(link.port) as late:
            assert late.read()[1] == "second"
        early.socket.sendall(b"whatever a client says")
        link.publish(named("third"))
        assert early.read()[1] == "third"


def test_a_port_that_is_taken_is_named() -> None:
    with (
        serving(0, "127.0.0.1") as link,
        pytest.raises(CaseError, match=f"port {link.port} cannot be opened"),
        serving(link.port, "127.0.0.1"),
    ):
        pass


def test_a_missing_extra_and_a_folder_that_is_no_result_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(CaseError, match="is no results folder"):
        messages_of(tmp_path)
    monkeypatch.setattr("vatsloc.navigation.messages.find_spec", lambda name: None)
    with pytest.raises(CaseError, match=r'pip install "vatsloc\[navigation\]"'):
        messages_of(tmp_path)


def test_an_ellipsoid_of_mirrored_axes_stays_outward() -> None:
    axes = np.diag([3.0, 2.0, 1.0])[[1, 0, 2]]
    points, triangles = ellipsoid_surface(np.zeros(3), axes)
    corners = points[triangles]
    assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_localize_serves_its_answer_until_it_is_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = scene.write_case_file(tmp_path / "case")
    write_series(case / "deflated", scene.scan(), Ids())
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])

    def run_case(folder: Path, out: Path, *_: Any) -> dict[str, Any]:
        with connected(port) as early:  # a screen may wait from the start, and is told nothing yet
            early.socket.settimeout(0.5)
            with pytest.raises(TimeoutError):
                early.read()
        data = scene.result(failed=True)
        scene.write_result(out, folder, data)
        return data.run.as_json()

    got: dict[str, Any] = {}
    monkeypatch.setattr("vatsloc.workflow.run.run_case", run_case)
    monkeypatch.setattr("vatsloc.cli._until_interrupted", lambda sentence: got.update(received(port)))
    with pytest.raises(SystemExit) as ended:
        main(["localize", str(case), "--out", str(tmp_path / "out"), "--openigtlink", str(port)])
    assert ended.value.code == 5  # the gate counts all the same
    assert got["nodule"].names == ["nodule: DO NOT TRUST"]
    assert_allclose(got["nodule"].positions, [scene.NODULE], atol=1e-4)
