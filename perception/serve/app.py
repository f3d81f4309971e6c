"""The routes: a question in, an answer of the engine out."""

from __future__ import annotations

import io
import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from perception.errors import InputError
from perception.query.crops import best_crop
from perception.query.engine import QueryEngine
from perception.query.frames import Frame
from perception.query.opened import LoadedMap, UnknownInstance
from perception.query.requests import frame_from_json, requests_from_json
from perception.query.where import where_from_json
from perception.serve.errors import HANDLERS, OtherMap
from perception.serve.guard import Guard
from perception.serve.openapi import document
from perception.serve.points import FORMATS, encode
from perception.serve.settings import ServeSettings

T = TypeVar("T")
_MOST_CROPS = 256
_SIDES = (16, 1024)


def build_app(engine: QueryEngine, settings: ServeSettings) -> Starlette:
    """The ASGI application that serves `engine`; who starts the engine closes it."""
    handlers = _Handlers(engine)
    routes = [
        Route("/", _static("page.html", "text/html")),
        Route("/page.js", _static("page.js", "text/javascript")),
        Route("/page.css", _static("page.css", "text/css")),
        Route("/openapi.json", handlers.openapi),
        Route("/health", handlers.health),
        Route("/query", handlers.query, methods=["POST"]),
        Route("/find", handlers.find, methods=["POST"]),
        Route("/nearest", handlers.nearest, methods=["POST"]),
        Route("/at", handlers.at, methods=["POST"]),
        Route("/reload", handlers.reload, methods=["POST"]),
        Route("/instances", handlers.instances),
        Route("/instances/{id}", handlers.describe),
        Route("/instances/{id}/points", handlers.points),
        Route("/instances/{id}/crop.jpg", handlers.crop),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard, settings=settings)], exception_handlers=HANDLERS)


class _Handlers:
    """One method a route. Each answer is made by one map, named in `map_id` or in the header X-Map-Id."""

    def __init__(self, engine: QueryEngine) -> None:
        self.engine = engine
        self._crops: OrderedDict[tuple[str, int, int], bytes | None] = OrderedDict()
        self._lock = threading.Lock()

    async def openapi(self, request: Request) -> Response:
        return JSONResponse(document())

    async def health(self, request: Request) -> Response:
        health = self.engine.health()
        shown = health if request.state.trusted else {"status": health["status"]}
        return JSONResponse(shown, 200 if health["status"] != "closed" else 503)

    async def query(self, request: Request) -> Response:
        questions = requests_from_json(await _json(request))

        def work(gmap: LoadedMap) -> dict[str, Any]:
            results = []
            for q in questions:
                hits = gmap.query(q.text, q.top_k, q.min_score, where=q.where, frame=q.frame)
                results.append({"text": q.text, "present": bool(hits), "hits": [hit.to_json() for hit in hits]})
            return {"results": results, **_source(gmap, questions[0].frame)}

        return JSONResponse(await self._answer(request, work))

    async def find(self, request: Request) -> Response:
        body = _fields(await _json(request), "where", "frame")
        where, frame = where_from_json(body.get("where") or {}), _frame(body)
        return await self._hits(request, lambda gmap: gmap.find(where, frame=frame), frame)

    async def nearest(self, request: Request) -> Response:
        body = _fields(await _json(request), "near", "top_k", "where", "frame")
        if "near" not in body:
            raise InputError('nearest: "near" is missing, the point [3] or pose [4, 4] to measure from')
        where, frame, top_k = where_from_json(body.get("where") or {}), _frame(body), body.get("top_k", 1)
        if isinstance(top_k, bool) or not isinstance(top_k, int):
            raise InputError(f"nearest: top_k is {top_k!r}, expected a whole number")
        return await self._hits(
            request, lambda gmap: gmap.nearest(body["near"], top_k, where=where, frame=frame), frame
        )

    async def at(self, request: Request) -> Response:
        body = _fields(await _json(request), "point", "max_distance", "frame")
        if "point" not in body:
            raise InputError('at: "point" is missing, the point [3] asked about')
        frame, most = _frame(body), body.get("max_distance")
        if most is not None and (isinstance(most, bool) or not isinstance(most, (int, float))):
            raise InputError(f"at: max_distance is {most!r}, expected a number")

        def work(gmap: LoadedMap) -> list[Any]:
            hit = gmap.instance_at(body["point"], max_distance=most, frame=frame)
            return [] if hit is None else [hit]

        return await self._hits(request, work, frame)

    async def instances(self, request: Request) -> Response:
        return await self._hits(request, lambda gmap: gmap.find(), None)

    async def describe(self, request: Request) -> Response:
        number = _id(request)
        return JSONResponse(
            await self._answer(request, lambda gmap: {**gmap.describe(number).to_json(), **_source(gmap, None)})
        )

    async def points(self, request: Request) -> Response:
        number, kind = _id(request), request.query_params.get("format", "npz")
        if kind not in FORMATS:
            raise InputError(f"format: found '{kind[:20]}', expected {' or '.join(FORMATS)}")
        map_id, data = await self._answer(request, lambda gmap: (gmap.map_id, encode(gmap, number, kind)))
        name = f'attachment; filename="instance_{number}.{kind}"'
        return Response(data, media_type=FORMATS[kind], headers={"X-Map-Id": map_id, "Content-Disposition": name})

    async def crop(self, request: Request) -> Response:
        number, side = _id(request), _side(request)
        map_id, data = await self._answer(request, lambda gmap: (gmap.map_id, self._jpeg(gmap, number, side)))
        if data is None:
            raise UnknownInstance(f"instance {number}: no photo of it can be read")
        return Response(data, media_type="image/jpeg", headers={"X-Map-Id": map_id})

    async def reload(self, request: Request) -> Response:
        changed = await run_in_threadpool(self.engine.reload)
        return JSONResponse({"changed": changed, "map_id": self.engine.current.map_id})

    # ------------------------------------------------------------------ shared

    async def _answer(self, request: Request, work: Callable[[LoadedMap], T]) -> T:
        """`work` done by the engine, on the map that the client means if it says so by ?map_id=…"""
        wanted = request.query_params.get("map_id")

        def checked(gmap: LoadedMap) -> T:
            if wanted is not None and wanted != gmap.map_id:
                raise OtherMap(f"the map is now {gmap.map_id}, not {wanted[:40]}; ask again")
            return work(gmap)

        return await self.engine.awaited(self.engine.run(checked))

    async def _hits(self, request: Request, work: Callable[[LoadedMap], list[Any]], frame: Frame | None) -> Response:
        def answer(gmap: LoadedMap) -> dict[str, Any]:
            return {"hits": [hit.to_json() for hit in work(gmap)], **_source(gmap, frame)}

        return JSONResponse(await self._answer(request, answer))

    def _jpeg(self, gmap: LoadedMap, number: int, side: int) -> bytes | None:
        key = (gmap.map_id, number, side)
        with self._lock:
            if key in self._crops:
                return self._crops[key]
        data = _encode_jpeg(best_crop(gmap, number, side))
        with self._lock:
            self._crops[key] = data
            if len(self._crops) > _MOST_CROPS:
                self._crops.popitem(last=False)
        return data


def _source(gmap: LoadedMap, frame: Frame | None) -> dict[str, Any]:
    return {"frame": frame.name if frame else gmap.frame, "metric": gmap.metric, "map_id": gmap.map_id}


async def _json(request: Request) -> Any:
    try:
        return json.loads(await request.body(), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is no JSON ({str(error)[:120]})") from error


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON number")


def _fields(value: Any, *known: str) -> dict[str, Any]:
    if not isinstance(value, dict) or not set(value) <= set(known):
        found = sorted(value)[:5] if isinstance(value, dict) else type(value).__name__
        raise InputError(f"found {found}, expected an object with {', '.join(known)}")
    return value


def _frame(body: dict[str, Any]) -> Frame | None:
    return None if body.get("frame") is None else frame_from_json(body["frame"])


def _id(request: Request) -> int:
    text = request.path_params["id"]
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise UnknownInstance(f"instance '{text[:20]}': expected a whole number")
    return int(text)


def _side(request: Request) -> int:
    text = request.query_params.get("side", "256")
    side = int(text) if text.isascii() and text.isdigit() and len(text) < 6 else 0
    if not _SIDES[0] <= side <= _SIDES[1]:
        raise InputError(f"side: found '{text[:20]}', expected {_SIDES[0]} to {_SIDES[1]} pixels")
    return side


def _encode_jpeg(picture: Any) -> bytes | None:
    if picture is None:
        return None
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


def _static(name: str, kind: str) -> Any:
    content = (Path(__file__).parent / name).read_bytes()

    async def serve(request: Request) -> Response:
        return Response(content, media_type=kind)

    return serve
