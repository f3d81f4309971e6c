"""Writes a mesh as binary glTF 2.0 (.glb)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from perception.io.atomic import replacing

_FLOAT, _BYTE, _INDEX = 5126, 5121, 5125
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963


def write_glb(
    path: Path, points: np.ndarray, colors: np.ndarray, faces: np.ndarray, ids: np.ndarray, origin: np.ndarray
) -> None:
    """points [V, 3] float32, colors [V, 3] uint8 sRGB, faces [F, 3] int32, ids [V] int32.

    The node is moved by `origin` [3]. Ids are the vertex attribute `_INSTANCE_ID` (float, as glTF asks). Colours become
    linear, as glTF's are. The axes stay the map's; glTF viewers take y as up.
    """
    share = colors / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    shaded = np.concatenate([np.rint(linear * 255), np.full((len(colors), 1), 255)], axis=1).astype(np.uint8)
    rows: list[tuple[np.ndarray, int, str, int]] = [
        (points.astype("<f4"), _FLOAT, "VEC3", _VERTEX_BUFFER),
        (shaded, _BYTE, "VEC4", _VERTEX_BUFFER),
        (ids.astype("<f4"), _FLOAT, "SCALAR", _VERTEX_BUFFER),
        (faces.astype("<u4").reshape(-1), _INDEX, "SCALAR", _INDEX_BUFFER),
    ]
    data, parts, accessors = b"", [], []
    for n, (array, kind, shape, target) in enumerate(rows):
        parts.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target})
        accessors.append({"bufferView": n, "componentType": kind, "count": len(array), "type": shape})
        data += array.tobytes()  # every part is a multiple of four bytes
    accessors[0] |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    accessors[1]["normalized"] = True
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1, "_INSTANCE_ID": 2}, "indices": 3, "material": 0}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "perception"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": origin.tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": parts,
        "accessors": accessors,
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    with replacing(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(data), b"BIN\0") + data)
