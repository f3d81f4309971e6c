"""The HTTP routes: each passes a request to the engine and converts the result."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from fastapi import FastAPI, Path, Query, Request
from fastapi.responses import JSONResponse, Response
from starlette.concurrency import run_in_threadpool

from perception import __version__
from perception.io.ply import ply_bytes
from perception.query.query_map import QueryMap
from perception.query.where import Frame
from perception.serve.bodies import AtBody, FindBody, NearestBody, QueryBody
from perception.serve.engine import QueryEngine
from perception.serve.guard import HANDLERS, HttpGuard
from perception.serve.requests import ServeSettings, source

FORMATS = {"npz": "application/x-npz", "ply": "application/octet-stream"}
"""Name → media type."""


def encode(gmap: QueryMap, instance_id: int, kind: str) -> bytes:
    """The instance's points in the map's frame, in map order.

    npz: points [P, 3] float32, centroid [3], covariance [3, 3], obb_center, obb_rotation, obb_extent, instance_id,
    frame, metric, map_id. ply: binary, x y z float and instance_id int, as `perception export` writes.
    """
    hit = gmap.get(instance_id)
    if kind == "ply":
        columns = {axis: np.ascontiguousarray(hit.points[:, n]) for n, axis in enumerate("xyz")}
        ids = np.full(len(hit.points), instance_id, np.int32)
        return ply_bytes({"vertex": {**columns, "instance_id": ids}})
    buffer = io.BytesIO()
    np.savez(
        buffer,
        points=hit.points,
        centroid=hit.centroid,
        covariance=hit.covariance,
        obb_center=hit.obb.center,
        obb_rotation=hit.obb.rotation,
        obb_extent=hit.obb.extent,
        instance_id=np.int64(instance_id),
        frame=np.array(gmap.frame),
        metric=np.array(gmap.metric),
        map_id=np.array(gmap.map_id),
    )
    return buffer.getvalue()


T = TypeVar("T")
MapId = Annotated[str | None, Query(description="answer only from this very map, else 409")]
Id = Annotated[int, Path(alias="id", ge=0, lt=10**9)]
_ABOUT = (
    "Text prompts and positions in, 3D instances of a map out. Lengths are in the unit of the map's frame, metres when "
    "`metric`. With `frame`, everything in a request and its answer is in that frame. An error is one JSON object, "
    '{"error": line, "status": code}. Points are bytes; the header X-Map-Id names their map.'
)


def build_app(engine: QueryEngine, settings: ServeSettings) -> FastAPI:
    """The ASGI application that serves `engine`, which the caller closes."""
    app = FastAPI(
        title="perception",
        version=__version__,
        description=_ABOUT,
        docs_url=None,  # these pages load scripts from other servers
        redoc_url=None,
        redirect_slashes=False,
        exception_handlers=HANDLERS,
    )
    app.add_middleware(HttpGuard, settings=settings)
    routes = _Routes(engine)
    app.get("/health")(routes.health)
    app.post("/query")(routes.query)
    app.post("/find")(routes.find)
    app.post("/nearest")(routes.nearest)
    app.post("/at")(routes.at)
    app.post("/reload")(routes.reload)
    app.get("/instances")(routes.instances)
    app.get("/instances/{id}")(routes.describe)
    app.get("/instances/{id}/points", response_class=Response)(routes.points)
    return app


class _Routes:
    """One method per route. Each answer is computed on one map, given in `map_id` or in the header X-Map-Id."""

    def __init__(self, engine: QueryEngine) -> None:
        self.engine = engine

    async def health(self, request: Request) -> Response:
        """How the server is; without the token its status only."""
        health = self.engine.health()
        shown = health if request.state.trusted else {"status": health["status"]}
        return JSONResponse(shown, 200 if health["status"] != "closed" else 503)

    async def query(self, body: QueryBody, map_id: MapId = None) -> Response:
        """The instances that answer each text, ranked."""
        questions = body.requests()

        def work(gmap: QueryMap) -> dict[str, Any]:
            results = [question.answered(gmap, time.monotonic()).to_json() for question in questions]
            return {"results": results, **source(gmap, questions[0].frame)}

        return JSONResponse(await self._answer(map_id, work))

    async def find(self, body: FindBody, map_id: MapId = None) -> Response:
        """All instances that fulfil a filter."""
        where, frame = body.asked_where(), body.asked_frame()
        return await self._hits(map_id, lambda gmap: gmap.find(where, frame=frame), frame)

    async def nearest(self, body: NearestBody, map_id: MapId = None) -> Response:
        """The instances nearest to a point or pose."""
        where, frame, top_k = body.asked_where(), body.asked_frame(), body.top_k or 1
        return await self._hits(
            map_id, lambda gmap: gmap.nearest(np.array(body.near), top_k, where=where, frame=frame), frame
        )

    async def at(self, body: AtBody, map_id: MapId = None) -> Response:
        """The instance that a point lies on."""
        frame = body.asked_frame()

        def work(gmap: QueryMap) -> list[Any]:
            hit = gmap.instance_at(np.array(body.point), max_distance=body.max_distance, frame=frame)
            return [] if hit is None else [hit]

        return await self._hits(map_id, work, frame)

    async def instances(self, map_id: MapId = None) -> Response:
        """All instances."""
        return await self._hits(map_id, lambda gmap: gmap.find(), None)

    async def describe(self, number: Id, map_id: MapId = None) -> Response:
        """One instance."""
        described = await self._answer(map_id, lambda gmap: {**gmap.describe(number).to_json(), **source(gmap)})
        return JSONResponse(described)

    async def points(self, number: Id, map_id: MapId = None, format: Literal["npz", "ply"] = "npz") -> Response:
        """The instance's points, float32, in the map's frame; the header X-Map-Id names the map."""
        made_by, data = await self._answer(map_id, lambda gmap: (gmap.map_id, encode(gmap, number, format)))
        name = f'attachment; filename="instance_{number}.{format}"'
        return Response(data, media_type=FORMATS[format], headers={"X-Map-Id": made_by, "Content-Disposition": name})

    async def reload(self) -> Response:
        """Takes over the map that lies on disk now."""
        changed = await run_in_threadpool(self.engine.reload)
        return JSONResponse({"changed": changed, "map_id": self.engine.current.map_id})

    # ------------------------------------------------------------------ shared

    async def _answer(self, wanted: str | None, work: Callable[[QueryMap], T]) -> T:
        """The result of `work` in the engine."""
        return await self.engine.awaited(self.engine.run(work, map_id=wanted))

    async def _hits(self, wanted: str | None, work: Callable[[QueryMap], list[Any]], frame: Frame | None) -> Response:
        def answer(gmap: QueryMap) -> dict[str, Any]:
            return {"hits": [hit.to_json() for hit in work(gmap)], **source(gmap, frame)}

        return JSONResponse(await self._answer(wanted, answer))
