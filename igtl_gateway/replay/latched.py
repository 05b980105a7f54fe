"""A part of a session that begins in its middle: what was latched before comes first.

Whoever joins a running session is told the state that others were told before: static transforms, plans, meshes, the
last status.  A replay that begins at a moment, or jumps to one, tells it too: of every latched stream the last
message before the moment, in the order of the log.

Latched are

* ROS topics that were offered so (transient local);
* OpenIGTLink types that say a state rather than a sample: see :data:`STATE_TYPES`;
* what the gateway sent to the other side because of such a message.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator

from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.errors import GatewayError
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.sessionfile.lookup import LatchedStateRule

#: Surfaces, plans, annotations, tables, states: sent when they change, and valid until they change again.
STATE_TYPES = frozenset("BIND CAPABILITY COLORT COLORTABLE IMGMETA LBMETA POINT POLYDATA STATUS TRAJ VIDEOMETA".split())

_STATIC_TF = "/tf_static"
_ROS = frozenset({Kind.ROS_IN, Kind.ROS_OUT})
_MESSAGES = _ROS | {Kind.IGTL_IN, Kind.IGTL_OUT}

#: Whether a ROS topic of a type is latched.
IsLatched = Callable[[str, str], bool]


def part_of_session(
    entries: Iterable[Entry], start_ns: int | None, end_ns: int | None, is_latched: IsLatched
) -> Iterator[Entry]:
    """The entries from ``start_ns`` to ``end_ns`` (both included; None: no limit), the latched ones before them.

    Args:
        entries: the whole session, inputs too, in order; of what is before ``start_ns`` at least what
            :func:`latched_state_rule` names.
        is_latched: tells it of a topic and its type, as recorded.
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
    """What :func:`part_of_session` needs to see of the entries before its start."""
    return LatchedStateRule(
        lambda kind, channel, type_name: _is_state(kind, channel, type_name, is_latched),
        lambda channel: channel == _STATIC_TF,
    )


def _is_state(kind: Kind, channel: str, type_name: str, is_latched: IsLatched) -> bool:
    return type_name in STATE_TYPES or (kind in _ROS and is_latched(channel, type_name))


def _in_order(state: dict[Hashable, Entry]) -> list[Entry]:
    return sorted(state.values(), key=lambda entry: (entry.stamp_ns, entry.seq))


def _key(entry: Entry, latched: bool) -> Hashable:
    """What a later entry with the same key replaces; None for what is no state."""
    if not latched or entry.kind not in _MESSAGES:
        return None
    return (entry.kind, entry.channel, _frames(entry) if entry.channel == _STATIC_TF else ())


def _frames(entry: Entry) -> Hashable:
    """The frames of a message on /tf_static: its publishers are many, and each tells its own."""
    try:
        transforms = TFMessage.unpack(entry.data()).transforms
    except GatewayError:
        return ()
    return tuple(transform.child_frame_id for transform in transforms)
