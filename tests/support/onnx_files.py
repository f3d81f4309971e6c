"""ONNX files of given inputs and outputs, written byte by byte: no exporter, no weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FLOAT, INT32, INT64 = 1, 6, 7


def field(number: int, value: int | bytes | str) -> bytes:
    """One protobuf field: a varint, or bytes with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    raw = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(raw)) + raw


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def value_info(name: str, shape: tuple[int | str, ...], kind: int) -> bytes:
    dims = b"".join(field(1, field(1, d) if isinstance(d, int) else field(2, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def write_onnx(path: Path, inputs: dict, outputs: dict) -> None:
    """inputs: name -> (shape, kind). outputs: name -> input to pass on, or a float32 array."""
    graph = b""
    for name, source in outputs.items():
        if isinstance(source, np.ndarray):
            tensor = b"".join(field(1, n) for n in source.shape) + field(2, FLOAT) + field(8, f"{name}_value")
            graph += field(5, tensor + field(9, source.astype("<f4").tobytes()))
            source = f"{name}_value"
        graph += field(1, field(1, source) + field(2, name) + field(4, "Identity"))
    graph += field(2, "graph")
    graph += b"".join(field(11, value_info(name, shape, kind)) for name, (shape, kind) in inputs.items())
    for name, source in outputs.items():
        shape = source.shape if isinstance(source, np.ndarray) else inputs[source][0]
        graph += field(12, value_info(name, shape, FLOAT))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 17)))


SAM_DECODER = {
    "image_embeddings": ((1, 2, 64, 64), FLOAT),
    "point_coords": ((1, "n", 2), FLOAT),
    "point_labels": ((1, "n"), FLOAT),
    "mask_input": ((1, 1, 256, 256), FLOAT),
    "has_mask_input": ((1,), FLOAT),
    "orig_im_size": ((2,), FLOAT),
}
