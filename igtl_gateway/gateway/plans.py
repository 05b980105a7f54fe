"""Express lanes: what the gateway does with the next message of a stream when nothing but its numbers is new.

The general way of a message (`igtl_gateway.gateway.core`) asks many questions whose answers are the same for every
message of a stream: which rows, names, frames, peers.  For poses, which come a thousand times a second, and for
texts, points, clouds and pictures the answers of the last message are kept as a *plan*.  A plan gives exactly the
entries, and the ledger exactly the counts, that the general way would have given, or None: then the message takes the
general way.

What the guard looks at (`igtl_gateway.gateway.guard`), a plan lets it look at, too: where there is anything to be said
of a message it gives no entries, and the general way has the message; the plan stays.

What makes them is in ``planning``.  Plans hold until something changes that their answers came from: a peer that comes,
goes, shows itself or asks for streams ends all of them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from igtl_gateway.buffers import Buffer
from igtl_gateway.convert.assembly import Form, VolumeAssembler
from igtl_gateway.convert.express import Fill
from igtl_gateway.gateway.guard import Watched
from igtl_gateway.gateway.peers import Peer
from igtl_gateway.gateway.reply import Reply
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.ledger import Ledger

#: Plans of each direction; streams beyond that take the general way.
MAX_PLANS = 4_096

#: Where the names of a stream end in the header of its messages: header version, type and device name.
NAMES = slice(0, 34)

#: Plans that a stream may wear out.
MAX_BUILDS = 8

#: Link and names; topic and ROS type.
ToRosKey = tuple[int, bytes]
ToIgtlKey = tuple[str, str]

Heard = Callable[[str, str], bool]
#: What keeps the last image of a device, and what the images of a plan are.
Volume = tuple[VolumeAssembler, Form, np.dtype[Any]]

#: A translation in OpenIGTLink, and at the beginning of a pose in CDR.
_PLACE_IGTL, _PLACE_ROS = struct.Struct(">3f"), struct.Struct("<3d")


class Plans:
    """The plans of a session, by what tells the streams apart.

    A plan that did not fit is given up, and made anew from the next message that took the general way; a stream that
    has worn out ``MAX_BUILDS`` of them keeps to the general way.
    """

    def __init__(self) -> None:
        self.to_ros: dict[ToRosKey, ToRosPlan] = {}
        self.to_igtl: dict[ToIgtlKey, ToIgtlPlan] = {}
        self._builds: dict[ToRosKey | ToIgtlKey, int] = {}

    def wants(self, key: ToRosKey | ToIgtlKey) -> bool:
        """Whether a plan for a stream would be of use."""
        if key in self.to_ros or key in self.to_igtl:
            return False
        builds = self._builds.get(key)
        return builds < MAX_BUILDS if builds is not None else len(self._builds) < MAX_PLANS

    def keep_to_ros(self, key: ToRosKey, plan: ToRosPlan | None) -> None:
        """Use a plan from now on; None: that there can be none."""
        self._keep(self.to_ros, key, plan)

    def keep_to_igtl(self, key: ToIgtlKey, plan: ToIgtlPlan | None) -> None:
        """The same for the other direction."""
        self._keep(self.to_igtl, key, plan)

    def _keep(self, plans: dict[Any, Any], key: ToRosKey | ToIgtlKey, plan: ToRosPlan | ToIgtlPlan | None) -> None:
        self._builds[key] = self._builds.get(key, 0) + 1 if plan else MAX_BUILDS
        if plan:
            plans[key] = plan

    def peers_changed(self) -> None:
        """Somebody came, went, showed what it is, or asked for something."""
        self.to_ros.clear()
        self.to_igtl.clear()
        self._builds.clear()


class ToRosPlan:
    """A message of one device, from one link: fill the CDR templates of its topics.

    Args:
        fill: ``pose_to_ros`` or ``bulk_to_ros``, with the ``sample`` and ``places`` (``at``, ``size``) that it takes.
        entry: of the message that the plan is made from.
        forms: topic, ROS type and form of each output.
        place_at: where the translation is in the message, of a pose.
        unmade: what is to be made of latched topics once somebody listens; the topics of ``forms`` that are such.
        volume: of pictures, which later ones may be parts of.
    """

    def __init__(
        self,
        fill: Fill,
        sample: bytes,
        places: tuple[int, int],
        entry: Entry,
        forms: Sequence[tuple[str, str, tuple[Any, ...]]],
        ratio: tuple[float, float],
        check_crc: bool,
        own: bool,
        ledger: Ledger,
        watched: Watched | None,
        place_at: int | None,
        unmade: tuple[dict[str, Any], frozenset[str]],
        volume: Volume | None = None,
    ) -> None:
        self._fill = fill
        self._sample = sample
        self._places = places
        self._watched = watched
        self._place, self._place_at = _PLACE_IGTL if place_at else None, place_at or 0
        self._channel, self._type = entry.channel, entry.type
        self._forms = tuple(form for _, _, form in forms)
        self._told = tuple((topic, ros_type, form, ledger.counter("ros_out", topic)) for topic, ros_type, form in forms)
        self._ratio = ratio
        self._check_crc = check_crc
        self._own = own
        self._count = ledger.counter("igtl_in", entry.channel)
        self._unmade, self._latched = unmade
        self._volume = volume

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], links: tuple[int, ...], heard: Heard | None
    ) -> list[Entry] | None:
        told, forms = self._told, self._forms
        if heard is not None:
            told = tuple(one for one in told if heard(one[0], one[1]))
            forms = tuple(form for _, _, form, _ in told)
            if self._latched and not self._latched <= {topic for topic, _, _, _ in told}:
                return []  # the last message is kept for the first who listens
            if not forms and self._place is None:
                return []  # bulk is looked at as it is made: the general way knows whether it is well
        at, size = self._places
        volume = self._volume
        if volume and not volume[0].takes(volume[1]):
            return []
        made = self._fill(payload[0], self._sample, at, size, self._check_crc, self._own, stamp_ns, self._ratio, forms)
        if made is None:
            return None
        source_ns, told_ns = made[0], made[1]
        watched = self._watched
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], self._place, self._place_at):
            return []
        entries = [Entry(seq, stamp_ns, Kind.IGTL_IN, self._channel, self._type, payload, links, source_ns)]
        step = 0
        for (topic, ros_type, _, published), cdr in zip(told, made[2:], strict=True):
            if cdr is None:
                continue
            step += 1
            published["published"] = published.get("published", 0) + 1
            entries.append(Entry(seq + step, stamp_ns + step, Kind.ROS_OUT, topic, ros_type, (cdr,), (), told_ns))
        for topic in self._latched:
            self._unmade.pop(topic, None)
        if volume:
            assembler, form, dtype = volume
            assembler.keep(form, dtype, memoryview(payload[0])[at : len(payload[0]) - size])
        count = self._count
        count["received"] = count.get("received", 0) + 1
        count["decoded"] = count.get("decoded", 0) + 1
        fate = "converted" if step or heard is None else "unheard"
        count[fate] = count.get(fate, 0) + 1
        return entries


class ToIgtlPlan:
    """A message of one topic, to the peers that are there: fill the templates of its messages.

    Args:
        fill: ``pose_to_igtl`` or ``bulk_to_igtl``, with the ``sample``, ``names`` and ``size`` that it takes.
        told: a reply and its form for each kind of peers.
        latest: the last message of each topic.
        place_at: where the translation is in the message, of a pose.
    """

    def __init__(
        self,
        fill: Fill,
        sample: bytes,
        names: tuple[int, ...],
        size: int,
        told: Sequence[tuple[Reply, tuple[Any, ...]]],
        peers: Sequence[Peer],
        ratio: tuple[float, float],
        own: bool,
        ledger: Ledger,
        channel: str,
        latest: dict[str, Entry],
        watched: Watched | None,
        place_at: int | None,
    ) -> None:
        self._fill = fill
        self._sample = sample
        self._names = names
        self._size = size
        self._told = tuple((reply, len(reply.links), ledger.counter("igtl_out", reply.channel)) for reply, _ in told)
        self._forms = tuple(form for _, form in told)
        self._peers = tuple(peers)
        self._ratio = ratio
        self._own = own
        self._count = ledger.counter("ros_in", channel)
        self._latest = latest
        self._watched = watched
        self._place, self._place_at = _PLACE_ROS if place_at else None, place_at or 0

    def __call__(
        self, seq: int, stamp_ns: int, payload: Sequence[Buffer], channel: str, ros_type: str, source_ns: int
    ) -> list[Entry] | None:
        made = self._fill(
            payload[0],
            self._sample,
            self._names,
            self._size,
            self._own,
            source_ns,
            stamp_ns,
            self._ratio,
            self._forms,
        )
        if made is None:
            return None
        told_ns = made[0]
        watched = self._watched
        if watched is not None and not watched.passes(stamp_ns, told_ns, payload[0], self._place, self._place_at):
            return []
        count = self._count
        count["received"] = count.get("received", 0) + 1
        count["converted"] = count.get("converted", 0) + 1
        for peer in self._peers:
            peer.said_ns = stamp_ns
            peer.sent += 1
        entry = self._latest[channel] = Entry(seq, stamp_ns, Kind.ROS_IN, channel, ros_type, payload, (), source_ns)
        entries = [entry]
        step = 0
        for reply, links, sent in self._told:
            step += 1
            sent["sent"] = sent.get("sent", 0) + links
            entries.append(
                Entry(
                    seq + step,
                    stamp_ns + step,
                    Kind.IGTL_OUT,
                    reply.channel,
                    reply.type,
                    (made[step],),
                    reply.links,
                    told_ns,
                )
            )
        return entries
