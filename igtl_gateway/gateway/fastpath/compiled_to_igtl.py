"""A compiled stream of a ROS topic: fills the numbers of each message into the templates of the messages to peers."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.convert.express import FillTemplate
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.fates import CONVERTED
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.output import Output
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.wire.header import TICKS_AT, U64

#: The translation at the beginning of a pose in CDR.
_PLACE = struct.Struct("<3d")
#: Gateway time (UTC ns) that no message has, in place of one that is not known yet.
_NO_TIME = 0


class CompiledToIgtl:
    """A compiled stream of one topic, for the connected peers.

    Args:
        fill: ``pose_to_igtl`` or ``bulk_to_igtl``, with its arguments ``sample``, ``names`` and ``size``.
        outputs: output and form for each header version and profile.
        latest: topic → its latest message.
        place_at: offset of the translation in the message, for poses.

    Attributes:
        sample, names, size, forms, peers, ratio, own, latest, watched: the arguments.
        outputs: output, number of links and counts of each form.
        count: counts of the topic.
        is_pose: it is a stream of poses, not of bulk.
    """

    def __init__(
        self,
        fill: FillTemplate,
        sample: bytes,
        names: tuple[int, ...],
        size: int,
        outputs: Sequence[tuple[Output, tuple[Any, ...]]],
        peers: Sequence[Peer],
        ratio: tuple[float, float],
        own: bool,
        ledger: Ledger,
        channel: str,
        latest: dict[str, Entry],
        watched: GuardedStream | None,
        place_at: int | None,
    ) -> None:
        self._fill = fill
        self.sample = sample
        self.names = names
        self.size = size
        self.outputs = tuple(
            (output, len(output.links), ledger.counter("igtl_out", output.channel)) for output, _ in outputs
        )
        self.forms = tuple(form for _, form in outputs)
        self.peers = tuple(peers)
        self.ratio = ratio
        self.own = own
        self.count = ledger.counter("ros_in", channel)
        self.latest = latest
        self.watched = watched
        self._place, self._place_at = _PLACE if place_at else None, place_at or 0
        self.is_pose = place_at is not None
        # the CRC is not that of the header, and the digits of no form are those of the message's stamp
        self._is_patched = all(digits_at >= -1 for _, _, digits_at in self.forms)

    def prepare(self, payload: Sequence[Buffer], source_ns: int) -> tuple[Any, ...] | bool:
        """Convert a message before it has a number; else return whether the full path has to convert it.

        False: the result depends on its gateway time.  Where only the header has that, it gets it later: ``_stamped``.
        """
        if not (self.own or self._is_patched):
            return False
        made = self._convert(payload, source_ns, _NO_TIME)
        if made is None:
            return source_ns > 0  # without a stamp of the sender, its metadata may have that of the gateway
        return made if made[0] != _NO_TIME or self._is_patched else False

    def _convert(self, payload: Sequence[Buffer], source_ns: int, stamp_ns: int) -> tuple[Any, ...] | None:
        return self._fill(
            payload[0],
            self.sample,
            self.names,
            self.size,
            self.own,
            source_ns,
            stamp_ns,
            self.ratio,
            self.forms,
        )

    def __call__(
        self,
        seq: int,
        stamp_ns: int,
        payload: Sequence[Buffer],
        channel: str,
        ros_type: str,
        source_ns: int,
        made: tuple[Any, ...] | None = None,
    ) -> list[Entry] | None:
        """Return the entries of a message; [] sends it to the full path, None also all further messages.

        ``made``: result of ``prepare``.
        """
        if made and made[0] == _NO_TIME:
            made = _stamped(made, stamp_ns)
        made = made or self._convert(payload, source_ns, stamp_ns)
        if made is None:
            return None
        shown_ns = made[0]
        watched = self.watched
        if watched is not None and not watched.passes_quickly(
            stamp_ns, shown_ns, payload[0], self._place, self._place_at
        ):
            return []
        count = self.count
        count["received"] = count.get("received", 0) + 1
        count[CONVERTED] = count.get(CONVERTED, 0) + 1
        for peer in self.peers:
            peer.last_sent_ns = stamp_ns
            peer.sent += 1
        entry = self.latest[channel] = Entry(seq, stamp_ns, Kind.ROS_IN, channel, ros_type, payload, (), source_ns)
        entries = [entry]
        step = 0
        for output, links, sent in self.outputs:
            step += 1
            message = made[step]
            sent["sent"] = sent.get("sent", 0) + links
            entries.append(
                Entry(
                    seq + step,
                    stamp_ns + step,
                    Kind.IGTL_OUT,
                    output.channel,
                    output.type,
                    message if type(message) is tuple else (message,),
                    output.links,
                    shown_ns,
                )
            )
        return entries


def _stamped(made: tuple[Any, ...], stamp_ns: int) -> tuple[Any, ...]:
    """Return what was made without a time, with gateway time: more buffers, so that none is copied."""
    ticks = U64.pack(ns_to_ticks(stamp_ns))
    return stamp_ns, *(_with_ticks(one if type(one) is tuple else (one,), ticks) for one in made[1:])


def _with_ticks(message: tuple[Buffer, ...], ticks: bytes) -> tuple[Buffer, ...]:
    head, *more = message
    return bytes(head[:TICKS_AT]) + ticks, memoryview(head)[TICKS_AT + len(ticks) :], *more
