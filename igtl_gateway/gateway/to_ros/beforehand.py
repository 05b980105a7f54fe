"""Work of the full path that is done before a message has its number: without the sequence lock, by any thread.

A surface takes a millisecond, which the poses of others would wait for the lock.  What depends on a message alone is
done beforehand.  The full path then asks for each result with all that it depends on, and does itself what it is not
given: its outputs are the same, and those of a verification, which has nothing of this.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import clouds, polydata, surfaces
from igtl_gateway.convert.cdr import CdrWriter
from igtl_gateway.convert.context import ToRosContext
from igtl_gateway.convert.rosmsg import Header, Mesh, RosMessage
from igtl_gateway.convert.table import ConversionToRos
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.metadata import restore_metadata
from igtl_gateway.gateway.output import Packed
from igtl_gateway.gateway.streams import ToRosStream
from igtl_gateway.gateway.to_ros.subscribers import Subscribers
from igtl_gateway.wire import Message
from igtl_gateway.wire.header import NAMES

#: Conversions that take long.  The stamp is in their results only where a header begins them.
LONG: frozenset[Callable[[Any, ToRosContext], RosMessage]] = frozenset(
    {
        clouds.polydata_to_cloud,
        surfaces.polydata_to_mesh,
        surfaces.polydata_to_marker,
        surfaces.polydata_to_lines,
        polydata.polydata_to_ros,
    }
)
#: ROS types of them without a header.
_WITHOUT_STAMP = frozenset({Mesh.TYPE})

_MAX_STREAMS = 4_096
_STAMP_END = 12  # of CDR that begins with a header


@dataclass(frozen=True, slots=True)
class Results:
    """What a message has given beforehand.

    Attributes:
        payload: the message.
        decoded: its content, or why there is none.
        to: context of the conversions, without a stamp.
        made: conversion function → ROS message and warnings.
    """

    payload: Buffer
    decoded: Message | WireError
    to: ToRosContext | None = None
    made: dict[object, tuple[Packed, list[tuple[str, str]]]] = field(default_factory=dict)


class Beforehand:
    """The results of the next message, and what is needed to make them.

    Attributes:
        results: of the message that is handled now; set and used with the sequence lock.
    """

    def __init__(self, config: Config, subscribers: Subscribers) -> None:
        self.results: Results | None = None
        self._acceptance = Acceptance.of(config)
        self._subscribers = subscribers
        # link and names in the header → what the last message of a stream was converted with
        self._streams: dict[tuple[int, bytes], tuple[ToRosStream, ToRosContext]] = {}

    def learn(self, entry: Entry, stream: ToRosStream, to: ToRosContext) -> None:
        """Remember with what the messages of a stream are converted."""
        key = entry.links[0], bytes(entry.payload[0][NAMES])
        if key in self._streams or len(self._streams) < _MAX_STREAMS:
            if any(row.convert in LONG for row, _ in stream.outputs):
                self._streams[key] = stream, _alone(to)

    def forget(self, link: int | None = None) -> None:
        """Forget the streams of a link, or of all."""
        self._streams = {key: one for key, one in self._streams.items() if link is not None and key[0] != link}

    def work(self, payload: Buffer, link: int) -> Results:
        """Do what depends on the message alone; from any thread."""
        try:
            message = self._acceptance.message(payload)
        except WireError as error:
            return Results(payload, error)
        known = self._streams.get((link, bytes(payload[NAMES])))
        if known is None:
            return Results(payload, message)
        stream, before = known
        metadata = restore_metadata(message).items
        to = replace(before, metadata=metadata, message_id=message.message_id)
        results = Results(payload, message, to)
        for row, topic in stream.outputs:
            if (
                row.convert in LONG
                and isinstance(message.content, row.content)
                and row.applies(message.content)
                and self._subscribers.has(topic, row.message.TYPE)
            ):
                one = _alone(to)
                results.made[row.convert] = Packed.of(row.convert(message.content, one)), one.warnings
        return results

    def decode(self, entry: Entry) -> Message:
        """Return the decoded message of an entry.  Raises WireError."""
        results = self.results
        if results is None or results.payload is not entry.payload[0]:
            return self._acceptance.message(entry.payload[0])
        if isinstance(results.decoded, WireError):
            raise results.decoded
        return results.decoded

    def converted(
        self, entry: Entry, row: ConversionToRos, content: object, to: ToRosContext
    ) -> Sequence[Packed] | None:
        """Return the results of a conversion; None: it was not done with this content and context."""
        results = self.results
        if (
            results is None
            or row.convert not in results.made
            or isinstance(results.decoded, WireError)
            or content is not results.decoded.content
            or _alone(to) != results.to
        ):
            return None
        message, warnings = results.made[row.convert]
        to.warnings.extend(warnings)
        if message.TYPE in _WITHOUT_STAMP:
            return [message]
        head = CdrWriter()
        Header(to.stamp_ns).write(head)
        return [Packed(message.TYPE, head.finish()[:_STAMP_END] + message.cdr[_STAMP_END:])]


def _alone(to: ToRosContext) -> ToRosContext:
    """Return a context without its stamp, and without what other conversions have left in it."""
    return replace(to, stamp_ns=0, warnings=[], made={})
