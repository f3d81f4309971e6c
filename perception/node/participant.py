"""A DDS participant with ROS 2's conventions: writers and readers by ROS name and type, for raw CDR bytes.

Topics are `rt/NAME`; a service is `rq/NAMERequest` and `rr/NAMEReply`, whose
messages carry rmw_cyclonedds' header: the client's id (uint64) and the request's number (int64).
"""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from typing import Any
from xml.sax.saxutils import quoteattr

from perception.errors import InputError, missing_extra
from perception.node.channels import DEPTH
from perception.node.idl import sample_type

try:
    from cyclonedds import builtin, core, domain, pub, qos, sub, topic, util
except ImportError as error:
    raise missing_extra("cyclonedds", "ros") from error

_HEADER = struct.Struct("<Qq")
_MAX_BYTES = 256 << 20
"""Largest message in bytes, in or out; the network layer drops larger ones."""
_BLOCKED_MS = 100
"""Longest time that a write waits for slow readers; the message is dropped after that."""


class Participant:
    """A DDS participant. network: see NodeConfig. Raises InputError when the network cannot be used."""

    def __init__(self, number: int, network: str | None = None) -> None:
        try:
            _open_domain(number, network)
            self.participant = domain.DomainParticipant(number)
        except core.DDSException as error:
            raise InputError(
                f"node: DDS cannot start on domain {number}, network {network or 'as the system has it'} ({error}); "
                "check that the interface exists and is up (`ip addr`), or give --network localhost"
            ) from error
        self._publications = builtin.BuiltinDataReader(self.participant, builtin.BuiltinTopicDcpsPublication)

    def writer(self, name: str, kind: str, *, latched: bool = False, headed: bool = False) -> Writer:
        """A reliable writer of ROS type `kind` on DDS topic `name`; latched: late readers receive the last sample."""
        own = topic.Topic(self.participant, name, sample_type(kind, headed))
        return Writer(pub.DataWriter(self.participant, own, qos=_qos(latched)), kind, headed)

    def reader(self, name: str, kind: str, *, latched: bool = False, headed: bool = False) -> Reader:
        """A reliable reader; it keeps the DEPTH newest samples."""
        own = topic.Topic(self.participant, name, sample_type(kind, headed))
        return Reader(sub.DataReader(self.participant, own, qos=_qos(latched)), headed)

    def wait_set(self, readers: list[Reader]) -> Any:
        """A WaitSet, whose `wait(nanoseconds)` returns when one of the readers has samples."""
        waiting = core.WaitSet(self.participant)
        for reader in readers:
            waiting.attach(reader.condition)
        return waiting

    def writers_elsewhere(self, name: str) -> int:
        """The number of writers on DDS topic `name` in other participants, as discovered so far."""
        own = self.participant.guid
        alive = core.InstanceState.Alive
        condition = core.ReadCondition(self._publications, core.SampleState.Any | core.ViewState.Any | alive)
        found = self._publications.read(10_000, condition=condition)
        return sum(1 for one in found if one.topic_name == name and one.participant_key != own)

    def close(self) -> None:
        """Leaves the network at once instead of when the DDS lease ends. Closes all writers and readers."""
        self.participant.__del__()  # CycloneDDS has no other method for it; may be repeated


def _qos(latched: bool) -> Any:
    policy = qos.Policy
    return qos.Qos(
        policy.Reliability.Reliable(util.duration(milliseconds=_BLOCKED_MS)),
        policy.Durability.TransientLocal if latched else policy.Durability.Volatile,
        policy.History.KeepLast(1 if latched else DEPTH),
        policy.DataRepresentation(use_cdrv0_representation=True),
    )


_OPENING = threading.Lock()
_DOMAINS: dict[int, Any] = {}


def _open_domain(number: int, network: str | None) -> None:
    """Configures a DDS domain for this process. Only the first call for a domain has an effect."""
    with _OPENING:
        if number not in _DOMAINS:
            own = os.environ.get("CYCLONEDDS_URI", "")  # the user's settings there take precedence
            _DOMAINS[number] = domain.Domain(number, ",".join(filter(None, [network_settings(network), own])))


class Writer:
    """Sends CDR bytes. `given_up`: number of messages dropped because of slow readers."""

    def __init__(self, writer: Any, kind: str, headed: bool) -> None:
        self._writer, self._kind, self._headed = writer, kind, headed
        self.given_up = 0

    def write(self, cdr: bytes, header: tuple[int, int] | None = None) -> bool:
        """Sends a message; False when it was dropped. header: client id and number of a service's message."""
        if header is not None:
            cdr = cdr[:4] + _HEADER.pack(*header) + cdr[4:]
        try:
            self._writer.write(sample_type(self._kind, self._headed)(cdr))
        except core.DDSException:
            self.given_up += 1
            return False
        return True

    @property
    def readers(self) -> int:
        """The number of matched readers."""
        return len(self._writer.get_matched_subscriptions())


class Reader:
    """Receives CDR bytes."""

    def __init__(self, reader: Any, headed: bool) -> None:
        self._reader, self._headed = reader, headed
        states = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        self.condition = core.ReadCondition(reader, states)

    def take(self) -> Iterator[tuple[bytes, tuple[int, int] | None]]:
        """Received messages: CDR bytes and, for services, client and number. Too short ones give empty bytes."""
        for sample in self._reader.take(DEPTH):
            if not sample.sample_info.valid_data:  # a notice that a writer left, without data
                continue
            data = bytes(sample.data)
            if not self._headed:
                yield data, None
            elif len(data) < 4 + _HEADER.size:
                yield b"", None
            else:
                order = "<" if data[1] & 1 else ">"
                client, number = struct.unpack_from(f"{order}Qq", data, 4)
                yield data[:4] + data[4 + _HEADER.size :], (client, number)

    @property
    def writers(self) -> int:
        """The number of matched writers."""
        return len(self._reader.get_matched_publications())


def network_settings(network: str | None) -> str:
    """CycloneDDS configuration (XML) for a network: an interface's name, "localhost", or None for the network in ROS's
    environment variables, else CycloneDDS' default."""
    chosen = network or _from_environment()
    interfaces, discovery = "", ""
    if chosen == "localhost":
        interfaces = '<AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface name="lo"/></Interfaces>'
        discovery = _ON_THIS_MACHINE
    elif chosen:
        interfaces = f"<Interfaces><NetworkInterface name={quoteattr(chosen)}/></Interfaces>"
    return (
        f"<CycloneDDS><Domain><General>{interfaces}<MaxMessageSize>65500B</MaxMessageSize>"
        f"<FragmentSize>60000B</FragmentSize></General>{discovery}"
        "<Compatibility><AllowInvalidTryConstruct>true</AllowInvalidTryConstruct></Compatibility>"
        f"<Internal><MaxSampleSize>{_MAX_BYTES}B</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


_ON_THIS_MACHINE = (
    "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>63</MaxAutoParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
)
"""Discovery without multicast, as in ROS 2 on one machine: unicast to each of the well-known ports."""


def _from_environment() -> str | None:
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        return "localhost"
    return "localhost" if os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() in ("LOCALHOST", "OFF") else None
