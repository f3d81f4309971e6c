"""Network address and access rules of the servers of `perception serve` and `perception view`."""

from __future__ import annotations

import contextlib
import errno
import hmac
import ipaddress
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.errors import InputError, refuse_named_pipe
from perception.io.documents import refusing

MAKE_TOKEN = "openssl rand -hex 24 > token, then --token-file token"
_MIN_TOKEN = 16
_LOCAL_NAMES = {"localhost", "127.0.0.1", "[::1]"}
_BACKLOG = 256
_NOT_HERE = {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}


def is_local(host: str) -> bool:
    """Whether only this machine can reach a server that listens on `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_address(host: str, port: int, token: str | None) -> None:
    """Raises InputError for a port out of range, and for a host that others can reach without a token."""
    if not 0 <= port <= 65535:
        raise InputError(f"port: found {port}, expected 0 to 65535")
    if token is None and not is_local(host):
        raise InputError(f"host {host}: others could reach the map there, so a token is needed: {MAKE_TOKEN}")


@dataclass(frozen=True)
class Guard:
    """Who may use a server that listens on `host`: clients that show `token`; all, when it is None.

    Any web page in a browser on this machine can send requests here too. `names_this_machine` prevents DNS rebinding: a
    page of another site can make its name resolve to 127.0.0.1, so that the browser lets it read responses of this
    server. Its requests still have that name in the Host header.
    """

    host: str
    token: str | None

    def trusts(self, shown: str) -> bool:
        """Whether `shown` is the token, or none is needed; in a time that does not depend on where they differ."""
        return self.token is None or hmac.compare_digest(shown.encode("utf-8", "replace"), self.token.encode())

    def names_this_machine(self, header: str) -> bool:
        """Whether a request's Host header is a loopback name or `host`."""
        name = header[: header.index("]") + 1] if header.startswith("[") and "]" in header else header.partition(":")[0]
        return name.lower() in _LOCAL_NAMES | {url_host(self.host).lower()}


def url_host(host: str) -> str:
    """`host` as it stands in a URL: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host


def listen(host: str, port: int) -> socket.socket:
    """A bound, listening TCP socket: of a name's addresses the first that this machine has, IPv4 first. InputError
    naming the argument when the address or port is not available."""
    with refusing(f"host {host}: is no address of this machine ({{why}})"):
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    for family, _, _, _, address in sorted(found, key=lambda each: each[0] != socket.AF_INET):
        try:
            return _bound(family, address)
        except OSError as error:
            trouble = error
            if error.errno not in _NOT_HERE:
                break
    if trouble.errno == errno.EADDRINUSE:
        raise InputError(f"port {port}: is in use on {host}; stop that server or choose another port") from trouble
    if trouble.errno in _NOT_HERE:
        raise InputError(f"host {host}: is no address of this machine") from trouble
    raise InputError(f"host {host}, port {port}: cannot listen there ({trouble.strerror})") from trouble


def _bound(family: int, address: tuple[Any, ...]) -> socket.socket:
    with contextlib.ExitStack() as undo:
        sock = undo.enter_context(socket.socket(family, socket.SOCK_STREAM))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a restart must not wait for old connections
        sock.bind(address)
        sock.listen(_BACKLOG)
        undo.pop_all()
    return sock


def read_token(path: Path) -> str:
    """The token in a file, without outer white space; InputError when it is unreadable, too short or not ASCII."""
    refuse_named_pipe(path)
    with refusing(f"{path}: cannot be read as a token ({{why}})"):
        token = path.read_text(encoding="utf-8").strip()
    if len(token) < _MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            f"{path}: holds {len(token)} characters, expected one ASCII word of at least {_MIN_TOKEN}: {MAKE_TOKEN}"
        )
    return token
