"""Who may use the viewer's page: requests and websocket handshakes as other pages, users and names would send them."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from perception.cli import main
from perception.errors import InputError
from perception.map.write import write_map
from perception.viewer import Viewer
from support.viewer_maps import free_port, small_map

viser = pytest.importorskip("viser")
websockets = pytest.importorskip("websockets.exceptions")
ws = pytest.importorskip("websockets.sync.client")
TOKEN = "0123456789abcdef;%\"'"
"""With every character that a cookie or a URL must quote."""


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    path = tmp_path_factory.mktemp("guard") / "m.gsmap"
    write_map(path, small_map(60))
    running = Viewer(path, port=free_port(), token=TOKEN)
    yield running
    running.stop()


@pytest.fixture(scope="module")
def port(viewer: Any) -> int:
    return int(urlsplit(viewer.url).port or 0)


def get(port: int, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """A GET with these headers, `Host: localhost:PORT` unless given."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": f"localhost:{port}", **headers}.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def cookie(viewer: Any, port: int) -> str:
    """The cookie that the printed address gives a browser."""
    parts = urlsplit(viewer.url)
    status, headers, _ = get(port, f"{parts.path}?{parts.query}")
    assert status == 303 and headers["location"] == "/"
    kept, *flags = headers["set-cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Lax"} <= set(flags)
    return kept


def handshake(port: int, origin: str | None, cookie: str | None, host: str | None = None) -> int:
    """The status that a websocket handshake gets: 101 when it is accepted."""
    headers = {"Cookie": cookie} if cookie else {}
    uri = f"ws://{host or f'localhost:{port}'}/"
    protocol = [f"viser-v{viser.__version__}"]
    sock = socket.create_connection(("127.0.0.1", port), timeout=30)
    try:
        with ws.connect(uri, sock=sock, origin=origin, additional_headers=headers, subprotocols=protocol):
            return 101
    except websockets.InvalidStatus as error:
        return error.response.status_code


def test_a_page_of_another_origin_cannot_open_the_websocket(port: int, cookie: str) -> None:
    """Even with the browser's cookie, which a page of another port of localhost would send along."""
    for origin in ("http://evil.example", "null", "http://localhost:1", f"http://localhost.evil.example:{port}", ""):
        assert handshake(port, origin, cookie) == 403
    assert handshake(port, f"http://localhost:{port}", cookie) == 101


def test_a_foreign_host_name_is_refused(port: int, cookie: str) -> None:
    """DNS rebinding: evil.example resolves to 127.0.0.1, so Host and Origin agree, and both are foreign."""
    for host in (f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "", "a b", f"localhost:{port}; x", "[::1"):
        assert get(port, "/", Host=host, Cookie=cookie)[0] == 403
    assert handshake(port, f"http://evil.example:{port}", cookie, f"evil.example:{port}") == 403
    for host in (f"127.0.0.1:{port}", f"[::1]:{port}", f"LOCALHOST:{port}"):
        assert get(port, "/", Host=host, Cookie=cookie)[0] == 200


def test_without_the_token_neither_page_nor_websocket_is_given(port: int, cookie: str) -> None:
    name = cookie.partition("=")[0]
    wrong = (None, f"{name}=", f"{name}=wrong", f"{name}={TOKEN[:8]}", "other=1", ";;=;")
    for kept in wrong:
        status, _, body = get(port, "/", **({"Cookie": kept} if kept else {}))
        assert status == 403 and b"token" in body and b"<script" not in body
        assert handshake(port, f"http://localhost:{port}", kept) == 403
    assert get(port, "/?token=wrong")[0] == 403
    assert get(port, "/index.html")[0] == 403
    assert get(port, "/", Cookie=f"other={{]; {cookie}")[0] == 200


def test_through_a_tunnel_with_another_port_the_page_opens(viewer: Any, port: int) -> None:
    """ssh -L 9000:localhost:PORT: the browser says localhost:9000 in Host and Origin, and keeps a cookie for that."""
    status, headers, _ = get(port, f"/?{urlsplit(viewer.url).query}", Host="localhost:9000")
    assert status == 303
    kept = headers["set-cookie"].partition(";")[0]
    assert get(port, "/", Host="localhost:9000", Cookie=kept)[0] == 200
    assert handshake(port, "http://localhost:9000", kept, "localhost:9000") == 101


def test_an_address_cannot_make_the_page_connect_elsewhere(port: int, cookie: str) -> None:
    """viser's page takes a websocket's address from ?websocket=…, and would run what that server sends."""
    status, headers, _ = get(port, "/?websocket=ws://evil.example", Cookie=cookie)
    assert status == 303 and headers["location"] == "/"
    policy = get(port, "/", Cookie=cookie)[1]["content-security-policy"]
    assert f"connect-src 'self' ws://localhost:{port} " in policy and "script-src-attr 'none'" in policy


def test_other_machines_need_a_token_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_map(tmp_path / "m.gsmap", small_map(60))
    for host in ("0.0.0.0", "::", "192.168.1.5"):
        assert main(["view", str(tmp_path / "m.gsmap"), "--host", host, "--port", str(free_port())]) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and "--token-file" in told
        with pytest.raises(InputError, match="token"):
            Viewer(tmp_path / "m.gsmap", host)
    (tmp_path / "token").write_text("short")
    assert main(["view", str(tmp_path / "m.gsmap"), "--token-file", str(tmp_path / "token")]) == 2


def test_a_viser_that_starts_its_server_otherwise_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from perception.serve.listening import Guard
    from perception.viewer.handshake import guarded_server

    class Other:
        def __init__(self, **_: Any) -> None:
            self.stopped = False
            made.append(self)

        def stop(self) -> None:
            self.stopped = True

    made: list[Other] = []
    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(InputError, match="cannot be guarded"):
        guarded_server(Guard("127.0.0.1", TOKEN), None)  # type: ignore[arg-type]
    assert made[0].stopped
