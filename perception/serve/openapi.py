"""The OpenAPI 3.1 document of the server; tests hold it against the routes and against real answers."""

from __future__ import annotations

from typing import Any

from perception import __version__

Schema = dict[str, Any]


def document() -> Schema:
    """The document as plain JSON."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "perception",
            "version": __version__,
            "description": "Text prompts and places in, 3D instances of a map out. Lengths are in the unit of the "
            "map's frame, metres when `metric`. With `frame`, everything in a request and its answer is in that frame.",
        },
        "paths": _paths(),
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "responses": {"Error": _body(_ref("Error"), "one clear line")},
        },
        "security": [{}, {"token": []}],
    }


def _paths() -> Schema:
    number = {"name": "id", "in": "path", "required": True, "schema": {"type": "integer", "minimum": 0}}
    pinned = {
        "name": "map_id",
        "in": "query",
        "schema": {"type": "string"},
        "description": "answer only from this very map, else 409",
    }
    hits = _answers(_body(_ref("Hits"), "the instances"))
    return {
        "/query": _post("the instances that answer each text", "Query", _body(_ref("Results"), "ranked"), [pinned]),
        "/find": _post("all instances that fulfil a filter", "Find", hits["200"], [pinned]),
        "/nearest": _post("the instances nearest to a point or pose", "Nearest", hits["200"], [pinned]),
        "/at": _post("the instance that a point lies on", "At", hits["200"], [pinned]),
        "/reload": _post("take over the map that lies on disk now", "Nothing", _body(_ref("Reload"), "done"), []),
        "/instances": _get("all instances", hits, [pinned]),
        "/instances/{id}": _get("one instance", _answers(_body(_ref("Description"), "it")), [number, pinned]),
        "/instances/{id}/points": _get(
            "its points, float32, in the map's frame",
            _answers(_binary("application/x-npz", "application/octet-stream")),
            [number, pinned, {"name": "format", "in": "query", "schema": {"enum": ["npz", "ply"], "default": "npz"}}],
        ),
        "/instances/{id}/crop.jpg": _get(
            "the photo that shows it best, cut out",
            _answers(_binary("image/jpeg")),
            [number, pinned, {"name": "side", "in": "query", "schema": {"type": "integer", "default": 256}}],
        ),
        "/health": _get("how the server is", _answers(_body(_ref("Health"), "status first")), []),
        "/openapi.json": _get("this document", _answers(_body({"type": "object"}, "OpenAPI 3.1")), []),
    }


def _schemas() -> Schema:
    number, text, flag = {"type": "number"}, {"type": "string"}, {"type": "boolean"}
    count = {"type": "integer", "minimum": 0}
    point = {"type": "array", "items": number, "minItems": 3, "maxItems": 3}
    rows = {"type": "array", "items": point, "minItems": 3, "maxItems": 3}
    pose = {"type": "array", "items": {"type": "array", "items": number, "minItems": 4, "maxItems": 4}}
    label = {"type": ["string", "null"]}
    source = {"frame": text, "metric": flag, "map_id": text}
    box = _object({"center": point, "rotation": rows, "extent": point})
    hit = {
        "instance_id": count,
        "score": {"type": "number", "minimum": 0, "maximum": 1},
        "num_points": count,
        "centroid": point,
        "obb": _ref("Box"),
        "label": label,
        "views": {"type": "array", "items": text},
        "covariance": rows,
    }
    near = {"anyOf": [point, {**pose, "minItems": 4, "maxItems": 4}]}
    where, frame = {"anyOf": [_ref("Where"), {"type": "null"}]}, {"anyOf": [_ref("Frame"), {"type": "null"}]}
    hits = {"type": "array", "items": _ref("Hit")}
    neighbor = _object({"instance_id": count, "label": label, "gap": number})
    optional_number, top = {"type": ["number", "null"]}, {"type": "integer", "minimum": 1, "maximum": 1000}
    prompt = {"type": "string", "minLength": 1, "maxLength": 1000}
    texts = {"anyOf": [prompt, {"type": "array", "items": prompt, "minItems": 1, "maxItems": 32}]}
    return {
        "Error": _object({"error": text, "status": {"type": "integer"}}),
        "Box": box | {"description": "rows of `rotation` are the box's axes; `extent` are full side lengths"},
        "Region": {
            "anyOf": [
                _object({"min": point, "max": point}),
                _object({"center": point, "extent": point, "rotation": rows}, "center", "extent"),
                _object(
                    {
                        "polygon": {
                            "type": "array",
                            "minItems": 3,
                            "items": {"type": "array", "items": number, "minItems": 2, "maxItems": 2},
                        },
                        "low": number,
                        "high": number,
                    },
                    "polygon",
                ),
            ]
        },
        "Where": _object(
            {
                "region": _ref("Region"),
                "share": {"type": "number", "exclusiveMinimum": 0, "maximum": 1, "default": 0.5},
                "near": near,
                "within": number,
                "min_size": number,
                "max_size": number,
                "labels": {"anyOf": [text, {"type": "array", "items": text}]},
            },
            none_needed=True,
        ),
        "Frame": _object({"name": text, "from_map": {**pose, "minItems": 4, "maxItems": 4}}),
        "Query": _object(
            {"text": texts, "top_k": top, "min_score": optional_number, "where": where, "frame": frame}, "text"
        ),
        "Find": _object({"where": where, "frame": frame}, none_needed=True),
        "Nearest": _object({"near": near, "top_k": top, "where": where, "frame": frame}, "near"),
        "At": _object({"point": point, "max_distance": optional_number, "frame": frame}, "point"),
        "Nothing": {"type": "object"},
        "Hit": _object({**hit, "distance": number}, *hit),
        "Hits": _object({"hits": hits, **source}),
        "Results": _object(
            {
                "results": {"type": "array", "items": _object({"text": text, "present": flag, "hits": hits})},
                **source,
            }
        ),
        "Description": _object(
            {
                **hit,
                "confidence": number,
                "aabb": _object({"min": point, "max": point}),
                "colors": {"type": "array", "items": _object({"name": text, "share": number})},
                "neighbors": {"type": "array", "items": neighbor},
                **source,
            }
        ),
        "Reload": _object({"changed": flag, "map_id": text}),
        "Health": {
            "type": "object",
            "required": ["status"],
            "properties": {"status": {"enum": ["ok", "degraded", "closed"]}, "problem": label, "map_id": text},
        },
    }


def _object(properties: Schema, *required: str, none_needed: bool = False) -> Schema:
    """An object with these properties and no others; all are required unless some are named."""
    needed = [] if none_needed else list(required or properties)
    return {"type": "object", "properties": properties, "required": needed, "additionalProperties": False}


def _ref(name: str) -> Schema:
    return {"$ref": f"#/components/schemas/{name}"}


def _body(schema: Schema, description: str) -> Schema:
    return {"description": description, "content": {"application/json": {"schema": schema}}}


def _binary(*kinds: str) -> Schema:
    return {"description": "bytes; the header X-Map-Id names the map", "content": {kind: {} for kind in kinds}}


def _answers(good: Schema) -> Schema:
    return {"200": good, "default": {"$ref": "#/components/responses/Error"}}


def _get(summary: str, responses: Schema, parameters: list[Schema]) -> Schema:
    return {"get": {"summary": summary, "parameters": parameters, "responses": responses}}


def _post(summary: str, schema: str, good: Schema, parameters: list[Schema]) -> Schema:
    body = {"required": True, "content": {"application/json": {"schema": _ref(schema)}}}
    return {"post": {"summary": summary, "parameters": parameters, "requestBody": body, "responses": _answers(good)}}
