"""The HTTP routes: each passes a request to the engine and converts the result."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from fastapi import Depends, FastAPI, Path, Query, Request
from fastapi.responses import JSONResponse, Response
from starlette.concurrency import run_in_threadpool

from perception import __version__
from perception.errors import InputError
from perception.io.json_shapes import LARGEST
from perception.io.ply import ply_bytes
from perception.query import Frame, Hit, QueryMap
from perception.serve.bodies import AtBody, FindBody, NearestBody, QueryBody
from perception.serve.engine import QueryEngine
from perception.serve.guard import HANDLERS, OPEN, HttpGuard
from perception.serve.localise import LocaliseBody
from perception.serve.requests import Request as Prompt
from perception.serve.requests import ServeSettings, error_line, source

FORMATS = {"npz": "application/x-npz", "ply": "application/octet-stream"}  # name → media type


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
    box = {"obb_center": hit.obb.center, "obb_rotation": hit.obb.rotation, "obb_extent": hit.obb.extent}
    fields = {"points": hit.points, "centroid": hit.centroid, "covariance": hit.covariance, **box, **source(gmap)}
    np.savez(buffer, instance_id=np.int64(instance_id), **fields)  # type: ignore[arg-type]
    return buffer.getvalue()


T = TypeVar("T")
MapId = Annotated[str | None, Query(description="answer only from this very map, else 409")]
At = Annotated[int | None, Query(ge=0, lt=10**9, description="as of this visit; else today")]
Since = Annotated[int | None, Query(ge=0, lt=10**9, description="a visit; else the one before the newest")]
Id = Annotated[int, Path(alias="id", ge=0, le=LARGEST)]
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
        dependencies=[Depends(refuse_unknown)],
    )
    app.add_middleware(HttpGuard, settings=settings)
    queries = MapQueries(engine)
    add_state(app, engine)
    add_searches(app, queries)
    add_instances(app, queries)
    add_localising(app, queries, settings)
    return app


async def refuse_unknown(request: Request) -> None:
    """InputError for a parameter of the address that the page does not know, as for a field of a body: `at` belongs to
    the address of a GET and to the body of a POST, and elsewhere the answer would be as of another visit."""
    known = [parameter.alias for parameter in request.scope["route"].dependant.query_params]
    other = next((name for name in request.query_params if name not in known), None)
    if other is not None and request.scope["path"] not in OPEN:
        raise InputError(f"{other[:80]}: no parameter of this address, which has {', '.join(known) or 'none'}")


@dataclass(frozen=True)
class MapQueries:
    """Runs queries in the engine, on the map with the id `map_id` if one is given."""

    engine: QueryEngine

    async def result(self, map_id: str | None, at: int | None, work: Callable[[QueryMap], T]) -> T:
        """What `work` returns of the map as of the visit `at`, None = today."""
        future = self.engine.run(lambda gmap: work(gmap if at is None else gmap.at(at)), map_id=map_id)
        return await self.engine.awaited(future)

    async def answer(
        self, work: Callable[[QueryMap], dict[str, Any]], map_id: str | None, at: int | None, frame: Frame | None = None
    ) -> Response:
        """What `work` finds of the map, in `frame`, with the facts of the map and its visits."""

        def answer(gmap: QueryMap) -> dict[str, Any]:
            return {**work(gmap), **source(gmap, frame), **gmap.visits_json()}

        return JSONResponse(await self.result(map_id, at, answer))


def _hits(found: Sequence[Hit]) -> dict[str, Any]:
    return {"hits": [hit.to_json() for hit in found]}


def add_localising(app: FastAPI, queries: MapQueries, settings: ServeSettings) -> None:
    @app.post("/localise")
    async def localise(body: LocaliseBody, map_id: MapId = None) -> Response:
        """The pose of a picture's camera, with its standard error; or why it is not in this map."""
        frame = body.query_frame()

        def work(gmap: QueryMap) -> dict[str, Any]:
            return {**body.answered(gmap, settings.photos), **source(gmap, frame)}

        return JSONResponse(await queries.result(map_id, None, work))


def add_state(app: FastAPI, engine: QueryEngine) -> None:
    @app.get("/health")
    async def health(request: Request) -> Response:
        """The state of the server; without the token its status only."""
        health = engine.health()
        shown = health if request.state.trusted else {"status": health["status"]}
        return JSONResponse(shown, 200 if health["status"] != "closed" else 503)

    @app.post("/reload")
    async def reload() -> Response:
        """Takes over the map that lies on disk now."""
        changed = await run_in_threadpool(engine.reload)
        return JSONResponse({"changed": changed, "map_id": engine.current.map_id})


def answers(gmap: QueryMap, requests: Sequence[Prompt]) -> list[dict[str, Any]]:
    """The entries of `results`: of a refused prompt text and error. InputError where all are refused."""
    found, refused = list[dict[str, Any]](), list[InputError]()
    for request in requests:
        try:
            found.append(request.answered(gmap).to_json())
        except InputError as error:
            refused.append(error)
            found.append({"text": request.text, "error": error_line(error)})
    if len(refused) == len(found):
        raise refused[0]
    return found


def add_searches(app: FastAPI, queries: MapQueries) -> None:
    @app.post("/query")
    async def query(body: QueryBody, map_id: MapId = None) -> Response:
        """The instances that answer each text, ranked; for a text that is refused, unless all are, "error" instead."""
        requests = body.requests()
        return await queries.answer(lambda gmap: {"results": answers(gmap, requests)}, map_id, None, requests[0].frame)

    @app.post("/find")
    async def find(body: FindBody, map_id: MapId = None) -> Response:
        """All instances that fulfil a filter."""
        where, frame = body.query_where(), body.query_frame()
        return await queries.answer(lambda gmap: _hits(gmap.find(where, frame=frame)), map_id, body.at, frame)

    @app.post("/nearest")
    async def nearest(body: NearestBody, map_id: MapId = None) -> Response:
        """The instances nearest to a point or pose."""
        where, frame, near = body.query_where(), body.query_frame(), np.array(body.near)

        def work(gmap: QueryMap) -> dict[str, Any]:
            return _hits(gmap.nearest(near, body.top_k or 1, where=where, frame=frame))

        return await queries.answer(work, map_id, body.at, frame)

    @app.post("/at")
    async def at(body: AtBody, map_id: MapId = None) -> Response:
        """The instance that a point lies on."""
        frame = body.query_frame()

        def work(gmap: QueryMap) -> dict[str, Any]:
            hit = gmap.instance_at(np.array(body.point), max_distance=body.max_distance, frame=frame)
            return _hits([] if hit is None else [hit])

        return await queries.answer(work, map_id, body.at, frame)


def add_instances(app: FastAPI, queries: MapQueries) -> None:
    @app.get("/instances")
    async def instances(map_id: MapId = None, at: At = None) -> Response:
        """All instances."""
        return await queries.answer(lambda gmap: _hits(gmap.find()), map_id, at)

    @app.get("/changes")
    async def changes(map_id: MapId = None, since: Since = None) -> Response:
        """What moved, came and went since an earlier visit, and what nobody looked at."""
        visit = "last" if since is None else since
        return await queries.answer(lambda gmap: gmap.changes_json(visit), map_id, None)

    @app.get("/instances/{id}")
    async def describe(number: Id, map_id: MapId = None, at: At = None) -> Response:
        """One instance."""
        return await queries.answer(lambda gmap: gmap.describe(number).to_json(), map_id, at)

    @app.get("/instances/{id}/points", response_class=Response)
    async def points(
        number: Id, map_id: MapId = None, at: At = None, format: Literal["npz", "ply"] = "npz"
    ) -> Response:
        """The instance's points, float32, in the map's frame; the header X-Map-Id names the map."""
        made_by, data = await queries.result(map_id, at, lambda gmap: (gmap.map_id, encode(gmap, number, format)))
        name = f'attachment; filename="instance_{number}.{format}"'
        return Response(data, media_type=FORMATS[format], headers={"X-Map-Id": made_by, "Content-Disposition": name})
