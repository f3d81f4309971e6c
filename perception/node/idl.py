"""CycloneDDS types that look to the network like ROS 2's own, and carry bytes that are already CDR.

ROS 2 puts messages on DDS under mangled names (`std_msgs::msg::dds_::String_` on topic `rt/…`); the type's
structure, announced with it, must hash to what ROS announces, or readers of some vendors refuse the match. A sample
holds its serialised bytes: rosbags makes them, CycloneDDS' own Python serialiser is two hundred times slower.
"""

from __future__ import annotations

import importlib
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

from perception.errors import missing_extra
from perception.io.cdr import typestore

_HASHING = threading.Lock()


def dds_type_name(kind: str) -> str:
    """`std_msgs/msg/String` as ROS 2 calls it on DDS: `std_msgs::msg::dds_::String_`."""
    package, space, name = kind.split("/")
    return f"{package}::{space}::dds_::{name}_"


@cache
def sample_type(kind: str, headed: bool = False) -> Any:
    """The class of samples of a ROS type, `sample_type(kind)(data)` with `data` the CDR bytes, head included.

    headed: with the 16 bytes of rmw_cyclonedds before a service's message (client's id uint64, number int64).
    """
    structure = _structure(kind, headed)

    def serialize(self: Any, *_: Any, **__: Any) -> bytes:
        return bytes(self.data)

    def deserialize(cls: Any, data: bytes, *_: Any, **__: Any) -> Any:
        return cls(data)

    def deserialize_key(cls: Any, *_: Any, **__: Any) -> Any:
        return cls(b"")

    def __init__(self: Any, data: bytes) -> None:
        self.data = data

    structure.__init__ = __init__
    structure.serialize = serialize
    structure.deserialize = classmethod(deserialize)
    structure.deserialize_key = classmethod(deserialize_key)
    with _HASHING, _as_ros_hashes():
        structure.__idl__.populate()
        structure.__idl__.fill_type_data()
    return structure


def type_hash(kind: str) -> bytes:
    """The 14 bytes that name the complete structure of a ROS type in discovery (OMG XTypes 1.3, EquivalenceHash)."""
    return bytes(sample_type(kind).__idl__.get_type_id().value)


def _structure(kind: str, headed: bool = False) -> Any:
    """An IdlStruct with the fields of a ROS type."""
    _idl()
    fields = {name: _annotation(definition) for name, definition in typestore().fielddefs[kind][1]}
    if headed:
        t = importlib.import_module("cyclonedds.idl.types")
        fields = {"rmw_client": t.uint64, "rmw_number": t.int64, **fields}
    return _class(dds_type_name(kind), fields)


@cache
def _nested(kind: str) -> Any:
    return _structure(kind)


def _class(name: str, fields: dict[str, Any]) -> Any:
    base = _idl().IdlStruct
    scoped = name.replace("::", ".")
    made = types.new_class(
        scoped.rsplit(".", 1)[1],
        (base,),
        {"typename": scoped},
        lambda space: space.update(__annotations__=dict(fields)),
    )
    return dataclass(made)


def _annotation(definition: tuple[Any, Any]) -> Any:
    t = importlib.import_module("cyclonedds.idl.types")
    kind, detail = definition
    if kind.name == "BASE":
        return _BASES.get(detail[0]) or getattr(t, _NAMES.get(detail[0], detail[0]))
    if kind.name == "NAME":
        return _nested(detail)
    inner, length = detail
    if kind.name == "ARRAY":
        return t.array[_annotation(inner), length]
    return t.sequence[_annotation(inner), length] if length else t.sequence[_annotation(inner)]


_BASES: dict[str, Any] = {"bool": bool, "string": str}
_NAMES = {"byte": "uint8", "octet": "uint8", "char": "uint8"}
"""ROS announces its byte and char as uint8."""


@contextmanager
def _as_ros_hashes() -> Iterator[None]:
    """ROS 2 sets no flag on the elements of a sequence or array where CycloneDDS says "discard what does not fit".

    The flags enter the hash of every type that holds one. CycloneDDS has no switch for it, so while types are hashed
    its name for that header is one that drops the flags; tests hold the hashes against those rclpy announces.
    """
    builder: Any = importlib.import_module("cyclonedds.idl._xt_builder")
    names = builder.xt

    class WithoutFlags:
        def __getattr__(self, name: str) -> Any:
            return plain_header if name == "PlainCollectionHeader" else getattr(names, name)

    def plain_header(equiv_kind: int, element_flags: Any) -> Any:
        del element_flags
        return names.PlainCollectionHeader(equiv_kind=equiv_kind, element_flags=names.MemberFlag())

    builder.xt = WithoutFlags()
    try:
        yield
    finally:
        builder.xt = names


def _idl() -> Any:
    try:
        return importlib.import_module("cyclonedds.idl")
    except ImportError as error:
        raise missing_extra("cyclonedds", "ros") from error
