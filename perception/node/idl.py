"""CycloneDDS types that equal ROS 2's own on the network, with samples that are already CDR bytes.

ROS 2 uses mangled names on DDS (`std_msgs::msg::dds_::String_` on topic `rt/…`). The type structure announced in
discovery must have the same hash as ROS 2's, or readers of some vendors refuse the match. A sample holds its serialised
bytes: rosbags makes them, because CycloneDDS' own Python serialiser is two hundred times slower.
"""

from __future__ import annotations

import threading
import types
from dataclasses import dataclass
from functools import cache
from hashlib import md5
from typing import Any

from perception.errors import missing_extra
from perception.io.cdr import typestore

try:
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl import types as t
except ImportError as error:
    raise missing_extra("cyclonedds", "ros") from error

_HASHING = threading.Lock()


def dds_type_name(kind: str) -> str:
    """`std_msgs/msg/String` as ROS 2 calls it on DDS: `std_msgs::msg::dds_::String_`."""
    package, space, name = kind.split("/")
    return f"{package}::{space}::dds_::{name}_"


@cache
def sample_type(kind: str, headed: bool = False) -> Any:
    """The class of samples of a ROS type, `sample_type(kind)(data)` with `data` the CDR bytes and their header.

    headed: a service message, with the 16 bytes of rmw_cyclonedds before it (client's id uint64, number int64).
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
    with _HASHING:
        structure.__idl__.populate()
        structure.__idl__.fill_type_data()
        _announce_as_ros(structure.__idl__)
    return structure


def type_hash(kind: str) -> bytes:
    """The 14 bytes that name the complete structure of a ROS type in discovery (OMG XTypes 1.3, EquivalenceHash)."""
    return bytes(sample_type(kind).__idl__.get_type_id().value)


def _structure(kind: str, headed: bool = False) -> Any:
    """An IdlStruct with the fields of a ROS type."""
    fields = {name: _annotation(definition) for name, definition in typestore().fielddefs[kind][1]}
    if headed:
        fields = {"rmw_client": t.uint64, "rmw_number": t.int64, **fields}
    return _class(dds_type_name(kind), fields)


@cache
def _nested(kind: str) -> Any:
    return _structure(kind)


def _class(name: str, fields: dict[str, Any]) -> Any:
    scoped, made = name.replace("::", "."), {"__annotations__": dict(fields)}
    return dataclass(
        types.new_class(scoped.rsplit(".", 1)[1], (IdlStruct,), {"typename": scoped}, lambda space: space.update(made))
    )


def _annotation(definition: tuple[Any, Any]) -> Any:
    kind, detail = definition
    if kind.name == "BASE":
        return _BASES.get(detail[0]) or getattr(t, _NAMES.get(detail[0], detail[0]))
    if kind.name == "NAME":
        return _nested(detail)
    inner, length = detail
    if kind.name == "ARRAY":
        return t.array[_annotation(inner), length]  # type: ignore[misc]
    return t.sequence[_annotation(inner), length] if length else t.sequence[_annotation(inner)]  # type: ignore[misc]


_BASES: dict[str, Any] = {"bool": bool, "string": str}
_NAMES = {"byte": "uint8", "octet": "uint8", "char": "uint8"}
"""ROS announces its byte and char as uint8."""


def _announce_as_ros(idl: Any) -> None:
    """Makes the type structure that discovery announces equal to the one of ROS 2.

    CycloneDDS sets the flag "discard what does not fit" on the elements of a sequence or array; ROS 2 sets none. The
    flags enter the hash of every type with such a member, and that hash those of the types that refer to it. So the
    flags are cleared and the hashes computed again until none changes. A hash is 14 bytes of the MD5 of the serialised
    type object (XTypes 1.3, 7.3.1.2.1.2). Tests compare the hashes with those that rclpy announces.

    CycloneDDS has no function to set a structure: the serialised form is set on the description of our own class.
    """
    info, mapping = idl.get_type_info(), idl.get_type_mapping()
    renamed: dict[bytes, bytes] = {}
    changed = True
    while changed:
        changed = False
        for pair in (*mapping.identifier_object_pair_minimal, *mapping.identifier_object_pair_complete):
            _rename(pair.type_object, renamed)
            digest = md5(_serialized(pair.type_object), usedforsecurity=False).digest()[:14]
            if (before := bytes(pair.type_identifier.value)) != digest:
                renamed[before], changed = digest, True
                _rename(pair.type_identifier, renamed)
    _rename([info, mapping.identifier_complete_minimal], renamed)
    idl._xt_bytedata = (_serialized(info), _serialized(mapping))


def _rename(value: Any, renamed: dict[bytes, bytes]) -> None:
    """Clears the element flags and replaces the type hashes in a tree of CycloneDDS' type objects."""
    if isinstance(value, (list, tuple)):
        for item in value:
            _rename(item, renamed)
    elif type(value).__name__ == "TypeIdentifier" and isinstance(value.value, bytes):
        while (digest := bytes(value.value)) in renamed:
            value.set(value.discriminator, renamed[digest])
    elif hasattr(value, "__idl__"):
        if type(value).__name__ == "PlainCollectionHeader":
            value.element_flags = type(value.element_flags)()
        for item in list(vars(value).values()):
            _rename(item, renamed)


def _serialized(value: Any) -> bytes:
    """The XCDR2 form without its 4-byte header; little-endian, as are all machines with CycloneDDS wheels."""
    return bytes(value.serialize(use_version_2=True)[4:])
