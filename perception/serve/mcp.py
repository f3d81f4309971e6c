"""`perception mcp`: a map as tools of language models, on the official MCP SDK, over stdio or streamable HTTP.

A tool is a pydantic model: of its arguments, with the fields of its answer as a method. Nothing here changes the map.
"""

from __future__ import annotations

import asyncio
import base64
import json
import logging
import threading
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
from pydantic import Discriminator, Field, Tag
from scipy.spatial import cKDTree

from perception import __version__
from perception.errors import InputError, missing_extra
from perception.geometry import scale_of
from perception.io.json_shapes import LARGEST
from perception.map.history import change_in
from perception.query import Frame, Hit, QueryMap, Where
from perception.query.crops import OUTSIDE, PhotoOutside, best_crop, photos_outside
from perception.query.hit import printed_texts
from perception.query.requests import MAX_TOP
from perception.query.robot_pose import where_to_stand
from perception.query.scene_graph import scene_graph
from perception.serve.answers import Answer, ChangesAnswer, DescribeAnswer, InstancesAnswer, MeasureAnswer, PoseAnswer
from perception.serve.bodies import AnyRegion, Body, FrameBody, Length, PointOrPose, Prompt, Text, Visit, parse
from perception.serve.engine import QueryEngine
from perception.serve.localise import GivenPhoto, Place
from perception.serve.requests import MAX_PICTURE, NoScale, ServeSettings, UnknownFrame, error_kind, error_line, source
from perception.serve.server import serve

try:
    from mcp import MCPError, types
    from mcp.server import Server
    from mcp.server.stdio import stdio_server
    from mcp.server.transport_security import TransportSecuritySettings
except ImportError as error:
    raise missing_extra("mcp", "mcp") from error

_log = logging.getLogger("perception.serve.mcp")
_ABOUT = (
    "A 3D map of things, called instances, made from photos. Lengths are in metres only when `metric`. Ids belong to "
    "one map: give its map_id with them, and a replaced map is an error, not a wrong answer. The kind of an error says "
    "what to do. unknown_instance, other_map: ask for ids again; busy, timeout: later; else: change the request."
)
CROP_SIDE = 512  # most pixels of the longer side of a picture

Id = Annotated[int, Field(ge=0, le=LARGEST, description="instance_id of an answer")]
Top = Annotated[int, Field(ge=1, le=MAX_TOP, description="most instances in the answer")]
Framed = Annotated[
    Annotated[Text, Tag("single")] | Annotated[FrameBody, Tag("nested")],
    Discriminator(lambda value: "single" if isinstance(value, str) else "nested"),
]


class LocaliseAnswer(Answer, Place): ...


class Tool(Body):
    """The arguments that all tools share. answer: the model of the answer."""

    answer: ClassVar[type[Answer]] = InstancesAnswer
    frame: Framed | None = Field(None, description="of question and answer: name and from_map; else the map's own")
    unit: Literal["m"] | None = Field(None, description="m: an error unless lengths are metres")
    map_id: Text | None = Field(None, description="of an earlier answer: an error if the map was replaced")

    def answered(self, gmap: QueryMap, photos: Path | None) -> tuple[dict[str, Any], bytes | None]:
        """The answer as JSON, and its picture as JPEG if it has one. photos: see `best_crop`. Raises UnknownFrame for a
        mere name that is not of the map's frame, NoScale when lengths are to be metres and are not."""
        if isinstance(self.frame, str) and self.frame != gmap.frame:
            known = f"'{gmap.frame}' or an object with name and from_map"
            raise UnknownFrame(f"frame: found '{self.frame[:40]}', expected {known}")
        frame = self.frame.frame() if isinstance(self.frame, FrameBody) else None
        facts = source(gmap, frame)
        if self.unit == "m" and not facts["metric"]:
            raise NoScale(f"unit: lengths in frame '{facts['frame']}' are not known to be metres; ask without unit")
        unit = "m" if facts["metric"] else f"unit of frame {facts['frame']}"
        fields = self.fields_of(gmap, frame, photos)
        image = fields.pop("image", None)
        jpeg = None if image is None else cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()
        return self.answer(**{**facts, "unit": unit, **fields}).model_dump(mode="json"), jpeg

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        """The fields of the answer but those of its map, frame and unit; "image": [h, w, 3] uint8 RGB, if any."""
        raise NotImplementedError


class Find(Tool):
    """The instances that a text names, best first. Often there is none: then the thing is not in the map. Of a map of
    several visits also what is gone, and when each was seen last."""

    text: Prompt = Field(description='a thing, such as "red mug" or "the book on the desk"')
    top_k: Top = 5
    at: Visit | None = Field(None, description="as of this visit; else today")

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        gmap = gmap if self.at is None else gmap.at(self.at)
        gone = gmap.gone(self.text, self.top_k, frame=frame)
        return {**_listed(gmap, gmap.query(self.text, self.top_k, frame=frame)), **gmap.visits_json()} | {
            "gone": _listed(gmap.last_known, gone)["hits"]
        }


class WhatChanged(Tool):
    """What moved, came and went since an earlier visit of the scene, and what nobody looked at."""

    answer = ChangesAnswer
    since: Visit | None = Field(None, description="a visit; else the one before the newest")

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        facts, known = gmap.changes_json("last" if self.since is None else self.since), gmap.last_known
        names = dict(zip((entry["id"] for entry in known.instances), _names(known), strict=True))
        moved = facts["changes"] if frame is None else [change_in(frame.from_map, each) for each in facts["changes"]]
        changes = [{**change, "names": names.get(change["instance_id"], [])} for change in moved]
        sure = [change["confidence"] for change in changes if change["confidence"] is not None]
        return {key: facts[key] for key in ("since", "visits")} | {
            "changes": changes,
            "confidence": min(sure, default=None),
        }


class ListObjects(Tool):
    """All instances, or those with at least half of their points in a region, which is a box."""

    region: AnyRegion | None = None

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        hits = gmap.find(None if self.region is None else Where(self.region.region()), frame=frame)
        return {**_listed(gmap, hits), "confidence": min((hit.score for hit in hits), default=None)}


class Nearest(Tool):
    """The instances nearest to a point, or to the origin of a pose, each with its distance."""

    point: PointOrPose
    top_k: Top = 1

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        return _listed(gmap, gmap.nearest(np.array(self.point), self.top_k, frame=frame))


class Describe(Tool):
    """One instance: names, size, colours, printed texts, neighbours, relations, and a picture."""

    answer = DescribeAnswer
    id: Id

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        described, position = gmap.describe(self.id, frame=frame), gmap.position(self.id)
        kind, image, note = "photo", None, None
        try:
            image = best_crop(gmap, self.id, CROP_SIDE, photos)
        except PhotoOutside:
            note = OUTSIDE
        if image is None:
            from perception.export.render import rendered_crop

            kind, image = "render", rendered_crop(gmap, self.id, CROP_SIDE)
        return {
            **described.to_json(),
            "names": _names(gmap)[position],
            "colors": dict(described.colors),
            "texts": printed_texts(gmap.instances[position]),
            "relations": [edge for edge in _relations(gmap) if str(self.id) in (edge["thing"], edge["other"])],
            "picture": None if image is None else kind,
            "image": image,
            "note": note,
        }


class Measure(Tool):
    """The distance between two instances: of their nearest points, and of their centres."""

    answer = MeasureAnswer
    a: Id
    b: Id

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        a, b = (gmap.get(number, frame=frame) for number in (self.a, self.b))
        if not len(a.points) or not len(b.points):
            raise InputError("measure: one of the two instances has no points")
        gaps, nearest = cKDTree(b.points).query(a.points)
        return {
            "distance": gaps.min(),
            "center_distance": np.linalg.norm(b.centroid - a.centroid),
            "nearest_points": [a.points[gaps.argmin()].tolist(), b.points[nearest[gaps.argmin()]].tolist()],
            "confidence": min(a.score, b.score),
        }


class WhereToStand(Tool):
    """The pose on the free floor from which a robot faces and sees an instance. Only where the map is metric."""

    answer = PoseAnswer
    id: Id
    radius: Annotated[Length, Field(description="of the robot, metres")] = 0.25
    distance: Annotated[Length, Field(description="wanted from the robot's centre to the instance, metres")] = 0.6

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        score = gmap.get(self.id).score
        if not gmap.metric:
            raise NoScale("where_to_stand: this map's scale is not known, and a robot's size is in metres")
        robot = where_to_stand(gmap, self.id, radius=self.radius, distance=self.distance, frame=frame)
        gap = robot.distance * (1.0 if frame is None else scale_of(frame.from_map))
        pose = {"position": robot.position.tolist(), "yaw": robot.yaw, "pose": robot.map_from_robot.tolist()}
        return {**pose, "distance": gap, "seen": robot.seen, "confidence": score}


class Localise(Tool, GivenPhoto):
    """Where a photo was taken: the pose of its camera with standard errors, or why it is not in this map."""

    answer = LocaliseAnswer

    def fields_of(self, gmap: QueryMap, frame: Frame | None, photos: Path | None) -> dict[str, Any]:
        return {**self.place(gmap, frame, photos), "confidence": None}


TOOLS: dict[str, type[Tool]] = {"localise": Localise, "find": Find, "list_objects": ListObjects, "describe": Describe}
TOOLS |= {"what_changed": WhatChanged, "nearest": Nearest, "where_to_stand": WhereToStand, "measure": Measure}


@lru_cache(maxsize=2)  # of the map, and of the map with what is gone
def _names(gmap: QueryMap) -> list[list[str]]:
    """The likely names of a map's instances in their order; empty lists when it cannot answer prompts."""
    return gmap.likely_names() if gmap.problem is None else [[] for _ in gmap.instances]


@lru_cache(maxsize=1)
def _relations(gmap: QueryMap) -> list[dict[str, Any]]:
    """The edges of the map's scene graph; none where it is not known which way is up."""
    with suppress(InputError):
        edges = scene_graph(gmap).edges(data="relation")
        return [{"thing": str(a), "relation": relation, "other": str(b)} for a, b, relation in edges]
    return []


def _listed(gmap: QueryMap, hits: list[Hit]) -> dict[str, Any]:
    entries = [{**hit.to_json(), "names": _names(gmap)[gmap.position(hit.instance_id)]} for hit in hits]
    return {"hits": entries, "confidence": hits[0].score if hits else None}


def make_server(engine: QueryEngine, photos: Path | None = None) -> Server[Any]:
    """The server that answers from `engine`. photos: see `best_crop`."""
    hints = types.ToolAnnotations(read_only_hint=True, idempotent_hint=True, open_world_hint=False)
    listed = [
        types.Tool(
            name=name,
            description=tool.__doc__,
            input_schema=tool.model_json_schema(),
            output_schema=tool.answer.model_json_schema(mode="serialization"),
            annotations=hints,
        )
        for name, tool in TOOLS.items()
    ]

    async def list_tools(_: Any, params: Any) -> types.ListToolsResult:
        return types.ListToolsResult(tools=listed)

    async def call_tool(_: Any, params: types.CallToolRequestParams) -> types.CallToolResult:
        if params.name not in TOOLS:
            raise MCPError(types.INVALID_PARAMS, f"no tool '{params.name[:40]}', expected one of: {', '.join(TOOLS)}")
        jpeg = None
        try:
            tool = parse(TOOLS[params.name], params.arguments or {})
            future = engine.run(partial(tool.answered, photos=photos), map_id=tool.map_id)
            result, jpeg = await engine.awaited(future)
        except Exception as error:
            kind, line = error_kind(error), error_line(error)
            if kind == "failed":
                _log.error("%s failed", params.name, exc_info=error)
                line = "the server failed on this request; its log says why"
            result = {"error": {"kind": kind, "message": line}}
        content: list[Any] = [types.TextContent(text=json.dumps(result, allow_nan=False))]
        if jpeg is not None:
            content.append(types.ImageContent(data=base64.b64encode(jpeg).decode(), mime_type="image/jpeg"))
        return types.CallToolResult(content=content, structured_content=result, is_error="error" in result)

    import perception.export.render  # noqa: F401  # torch, here and not within the time of the first answer

    for learn in (_names, lambda gmap: _names(gmap.last_known), _relations):  # which may take longer than an answer
        learn(engine.current)
        engine.on_reload(learn)
    if outside := photos_outside(engine.current, photos):
        _log.warning("%s", outside)
    schemas = {tool.name: tool.input_schema for tool in listed}
    handlers: dict[str, Any] = {"on_list_tools": list_tools, "on_call_tool": call_tool}
    about: dict[str, Any] = {"version": __version__, "instructions": _ABOUT}
    return Server("perception", get_tool_input_schema=schemas.get, **handlers, **about)


def serve_stdio(path: Path, encoders: Any = None, photos: Path | None = None) -> None:
    """Serves the map at `path` over standard input and output until the client ends. encoders: of QueryEngine;
    photos: see `best_crop`."""

    async def session(server: Server[Any]) -> None:
        async with stdio_server() as (read, write):
            await server.run(read, write, server.create_initialization_options())

    def work(server: Server[Any]) -> None:
        try:
            asyncio.run(session(server))
        except Exception as error:  # the SDK's tasks end in a group of errors when the client is gone
            if not isinstance(getattr(error, "exceptions", [error])[0], BrokenPipeError):
                raise

    with QueryEngine(path, encoders=encoders) as engine:  # Ctrl-C cannot end the thread, which waits for input
        thread = threading.Thread(target=work, args=(make_server(engine, photos),), daemon=True)
        thread.start()
        try:
            thread.join()
        finally:
            engine.close(wait=0)  # the client has gone


def serve_http(path: Path, settings: ServeSettings, encoders: Any = None) -> None:
    """Serves the map at `path` over streamable HTTP until SIGINT or SIGTERM, with the checks of `serve`.

    No session is kept: each request is answered by itself, so a client may vanish at any time.
    """
    from perception.serve.guard import HttpGuard

    def build(engine: QueryEngine, settings: ServeSettings) -> Any:
        server = make_server(engine, settings.photos)
        options: dict[str, Any] = {"stateless_http": True, "max_request_body_size": MAX_PICTURE, "host": settings.host}
        if settings.token is not None:  # behind a proxy, Host is the proxy's name; the SDK would refuse it
            options["transport_security"] = TransportSecuritySettings(enable_dns_rebinding_protection=False)
        app = server.streamable_http_app(**options)
        app.add_middleware(HttpGuard, settings=settings)
        return app

    serve(path, settings, encoders, build, "/mcp")
