"""The settings of the HTTP server, checked before anything is opened."""

from __future__ import annotations

from dataclasses import dataclass

from perception.errors import InputError
from perception.listening import check_address


@dataclass(frozen=True)
class ServeSettings:
    """host, port: where to listen (port 0: any free one). token: what clients must send as `Authorization: Bearer`;
    None only on this machine. timeout: seconds an answer may take. queue_size, workers: of the engine. max_body: bytes
    of a request. watch: seconds between looks at the map's directory, 0 = never."""

    host: str = "127.0.0.1"
    port: int = 8765
    token: str | None = None
    timeout: float = 10.0
    workers: int = 2
    queue_size: int = 64
    max_body: int = 64 << 10
    watch: float = 1.0

    def __post_init__(self) -> None:
        for name, least in (("timeout", 1e-3), ("workers", 1), ("queue_size", 1), ("max_body", 1)):
            if not getattr(self, name) >= least:
                raise InputError(f"serve: {name} is {getattr(self, name)}, expected at least {least}")
        if not self.watch >= 0:
            raise InputError(f"serve: watch is {self.watch}, expected at least 0")
        check_address(self.host, self.port, self.token)
