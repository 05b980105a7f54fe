"""Latched messages for a replay that starts in the middle of a session.

A late joiner gets the state that was published before: static transforms, plans, meshes, the latest status.  A replay
that starts at a moment, or seeks to one, also sends it first: the latest message before the moment of each latched
stream, in the order of the log.

Latched are

* ROS topics with transient-local durability;
* OpenIGTLink types that are a state and not a sample: see :data:`STATE_TYPES`;
* the outputs that such a message caused.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.lookup import LatchedStateRule

#: Surfaces, plans, annotations, tables, states: sent on a change, and valid until the next change.
STATE_TYPES = frozenset("BIND CAPABILITY COLORT COLORTABLE IMGMETA LBMETA POINT POLYDATA STATUS TRAJ VIDEOMETA".split())

_STATIC_TF = "/tf_static"
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_MESSAGES = _ROS | {Kind.IGTL_IN, Kind.IGTL_OUT}

#: ROS topic and type → whether the topic is latched.
IsLatched = Callable[[str, str], bool]


def part_of_session(
    entries: Iterable[Entry], start_ns: int | None, end_ns: int | None, is_latched: IsLatched
) -> Iterator[Entry]:
    """Yield the latched entries before ``start_ns``, then the entries to ``end_ns`` (both included; None: no limit).

    Args:
        entries: the session in order, with inputs; before ``start_ns`` at least the entries that
            :func:`latched_state_rule` selects.
        is_latched: returns whether a recorded topic is latched.
    """
    state: dict[Hashable, Entry] | None = {}
    cause_is_latched = False
    for entry in entries:
        if end_ns is not None and entry.stamp_ns > end_ns:
            break
        if start_ns is None or entry.stamp_ns >= start_ns:
            if state is not None:
                yield from _in_order(state)
                state = None
            yield entry
            continue
        latched = _is_state(entry.kind, entry.channel, entry.type, is_latched)
        if entry.kind.is_input:
            cause_is_latched = latched
        if state is not None and (key := _key(entry, latched or cause_is_latched)):
            state.pop(key, None)
            state[key] = entry
    if state:
        yield from _in_order(state)


def latched_state_rule(is_latched: IsLatched) -> LatchedStateRule:
    """Return the rule that selects the entries that :func:`part_of_session` needs from before its start."""
    return LatchedStateRule(
        lambda kind, channel, type_name: _is_state(kind, channel, type_name, is_latched),
        lambda channel: channel == _STATIC_TF,
    )


def _is_state(kind: Kind, channel: str, type_name: str, is_latched: IsLatched) -> bool:
    return type_name in STATE_TYPES or (kind in _ROS and is_latched(channel, type_name))


def _in_order(state: dict[Hashable, Entry]) -> list[Entry]:
    return sorted(state.values(), key=lambda entry: (entry.stamp_ns, entry.seq))


def _key(entry: Entry, latched: bool) -> Hashable:
    """Return the key of a latched entry: a later entry with the same key replaces it; None if it is not latched."""
    if not latched or entry.kind not in _MESSAGES:
        return None
    return (entry.kind, entry.channel, _frames(entry) if entry.channel == _STATIC_TF else ())


def _frames(entry: Entry) -> Hashable:
    """Return the frames of a message on /tf_static: each of its publishers publishes other frames."""
    try:
        transforms = TFMessage.unpack(entry.data()).transforms
    except GatewayError:
        return ()
    return tuple(transform.child_frame_id for transform in transforms)
