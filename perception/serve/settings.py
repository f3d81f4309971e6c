"""How a map is served, checked before anything is opened."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path

from perception.errors import InputError

_LEAST_TOKEN = 16


@dataclass(frozen=True)
class ServeSettings:
    """host, port: where to listen (port 0: any free one). token: what clients must send as `Authorization: Bearer`;
    None only on this machine. timeout: seconds an answer may take. queue_size, workers: of the engine. rate: requests a
    second and client, averaged, bursts of twice as many; 0 = no bound. max_body: bytes of a request. watch: seconds
    between looks at the map's directory, 0 = never."""

    host: str = "127.0.0.1"
    port: int = 8765
    token: str | None = None
    timeout: float = 10.0
    workers: int = 2
    queue_size: int = 64
    rate: float = 100.0
    max_body: int = 64 << 10
    watch: float = 1.0

    def __post_init__(self) -> None:
        for name, least in (("timeout", 1e-3), ("workers", 1), ("queue_size", 1), ("rate", 0), ("max_body", 1)):
            if not getattr(self, name) >= least:
                raise InputError(f"serve: {name} is {getattr(self, name)}, expected at least {least}")
        if not self.watch >= 0:
            raise InputError(f"serve: watch is {self.watch}, expected at least 0")
        if not 0 <= self.port <= 65535:
            raise InputError(f"--port: found {self.port}, expected 0 to 65535")
        if self.token is None and not self.local:
            raise InputError(
                f"--host {self.host}: others could reach the map there, so a token is needed: "
                "openssl rand -hex 24 > token, then --token-file token"
            )

    @property
    def local(self) -> bool:
        """Whether only this machine can reach the host."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


def read_token(path: Path) -> str:
    """The token in a file, white space around it dropped; InputError when it is unreadable, short or not ASCII."""
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a token ({error})") from error
    if len(token) < _LEAST_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(
            f"{path}: holds {len(token)} characters, expected one ASCII word of at least {_LEAST_TOKEN}: "
            "openssl rand -hex 24 > token"
        )
    return token
