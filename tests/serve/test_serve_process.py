"""A server as its own process: killed, restarted, shouted at, stopped."""

from __future__ import annotations

import contextlib
import http.client
import json
import signal
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from perception.cli import main
from support.processes import served, server
from support.query_maps import NAMES, write_map_of
from support.synthetic_map import write_synthetic_map

pytest.importorskip("starlette", reason="the extra 'serve' is not installed")
pytest.importorskip("uvicorn", reason="the extra 'serve' is not installed")


def ask(port: int, name: str, timeout: float = 10.0) -> dict[str, Any]:
    body = json.dumps({"text": name, "top_k": 1, "min_score": 0}).encode()
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/query", body, {"Content-Type": "application/json"}, method="POST"
    )
    with urllib.request.urlopen(request, timeout=timeout) as answer:
        return json.load(answer)


@pytest.mark.slow
def test_clients_recover_from_a_server_killed_and_restarted_under_load(tmp_path: Path) -> None:
    """Eight clients ask without pause and repeat what failed; every answer that comes is the right one."""
    path = write_map_of(tmp_path / "a.gsmap", gaussians=900)
    failures, answers, stop = [0] * 8, [[] for _ in range(8)], threading.Event()

    def client(port: int, number: int) -> None:
        while not stop.is_set():
            name = NAMES[(number + len(answers[number])) % len(NAMES)]
            try:
                result = ask(port, name)["results"][0]
            except (OSError, http.client.HTTPException, json.JSONDecodeError):  # refused, reset, cut off
                failures[number] += 1
                time.sleep(0.02)
                continue
            answers[number].append(result["text"] == name and result["hits"][0]["instance_id"] == NAMES.index(name))

    with served(path) as (first, port), ThreadPoolExecutor(8) as pool:
        try:
            clients = [pool.submit(client, port, number) for number in range(8)]
            _until(lambda: min(map(len, answers)) >= 2)
            first.send_signal(signal.SIGKILL)
            first.wait()
            _until(lambda: min(failures) >= 1)
            before = [len(right) for right in answers]
            with served(path, port) as (_, again):
                assert again == port
                _until(lambda: all(len(right) >= held + 2 for right, held in zip(answers, before, strict=True)))
                stop.set()
                for done in clients:
                    done.result(60)
        finally:
            stop.set()
    assert all(all(right) for right in answers)


def _until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Waits for other threads; the bound only ends a test that has failed."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.01)


def test_what_is_no_http_does_not_end_the_server(tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    hostile = [
        b"\x00\xff" * 500,
        b"GET / HTTP/9.9\r\n\r\n",
        b"POST /query HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999999\r\n\r\n",
        b"POST /query HTTP/1.1\r\nHost: localhost\r\nContent-Length: -5\r\n\r\n",
        b"POST /query HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 50\r\n\r\n{",
        b"GET /" + b"a" * 200_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 50_000 + b"\r\n",
        b"POST /query HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET /%00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /instances/../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ]
    with served(path) as (process, port):
        for data in hostile:
            with socket.create_connection(("127.0.0.1", port), timeout=5) as raw:
                try:
                    raw.sendall(data)
                    raw.shutdown(socket.SHUT_WR)
                    answer = raw.recv(65536)
                except OSError:
                    answer = b""
            assert b"root:" not in answer and b"Traceback" not in answer
        assert process.poll() is None
        assert ask(port, "mug")["results"][0]["hits"][0]["instance_id"] == 0


@pytest.mark.slow
def test_half_sent_headers_hold_up_nobody(tmp_path: Path) -> None:
    """300 connections that never finish their header; the server must answer others, and close these in the end."""
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    with served(path) as (_, port):
        held = [socket.create_connection(("127.0.0.1", port), timeout=60) for _ in range(300)]
        try:
            for raw in held:
                with contextlib.suppress(OSError):  # closed by the server already
                    raw.sendall(b"GET /health HTTP/1.1\r\nHost: local")
            for _ in range(20):
                assert ask(port, "mug")["results"][0]["hits"][0]["instance_id"] == 0
            for raw in held:
                with contextlib.suppress(ConnectionResetError):
                    assert raw.recv(1) == b""
        finally:
            for raw in held:
                raw.close()


@pytest.mark.slow
def test_a_header_after_an_answer_has_a_time_too(tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap", gaussians=300)
    with served(path) as (_, port), socket.create_connection(("127.0.0.1", port), timeout=60) as raw:
        raw.sendall(b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b" 200 OK" in raw.recv(65536)
        raw.sendall(b"GET /health HTTP/1.1\r\nHost: local")
        with contextlib.suppress(ConnectionResetError):
            while raw.recv(65536):
                pass


def test_a_port_in_use_is_told_before_the_map_is_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert main(["serve", str(tmp_path / "none.gsmap"), "--port", port]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"error: port {port}: is in use" in told


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_the_command_stops_when_told(tmp_path: Path, number: signal.Signals, code: int) -> None:
    """Served by the command itself; the map has no words, so it says so and answers about places."""
    path = tmp_path / "a.gsmap"
    write_synthetic_map(path, NAMES, None, gaussians=300, sh_degree=0)
    with server(["-m", "perception.cli", "serve", str(path), "--port", "0"], tmp_path) as (process, port):
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=10) as answer:
            health = json.load(answer)
        assert (health["status"], health["instances"]) == ("degraded", 9) and "no language" in health["problem"]
        with pytest.raises(urllib.error.HTTPError) as error:
            ask(port, "mug")
        assert error.value.code == 400
        process.send_signal(number)
        _, told = process.communicate(timeout=30)
        assert process.returncode == code and "Traceback" not in told
        if number == signal.SIGINT:
            assert told.strip().endswith("stopped")
