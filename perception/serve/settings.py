"""The settings of the HTTP server."""

from __future__ import annotations

from pydantic import Field

from perception.query.requests import MAX_BYTES, EngineSettings


class ServeSettings(EngineSettings):
    """How one process serves one map over HTTP. `server.serve` checks host and token."""

    host: str = Field("127.0.0.1", description="where to listen")
    port: int = Field(8765, ge=0, le=65535, description="0: any free one")
    token: str | None = Field(None, description="clients send it as a bearer token; none only on this machine")
    max_body: int = Field(MAX_BYTES, ge=1, description="bytes of a request")
