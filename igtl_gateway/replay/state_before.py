"""A part of a session with the state before it, for readers of messages.

A part of a split recording, and a snapshot, begin midway: static transforms, the description of a robot, plans and
surfaces may have been sent long before.  The prologue has them, so that the gateway can go on from there.  Here they
are the first messages of the part, at their recorded times, as in a slice.

Before them are the notes that hold until the end of the session: which names are shared, in which unit a peer has its
arms, how values are changed.  The gateway writes each once, often in the first part; it writes them again when it
goes through the prologue, which has the inputs that caused them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from io import BytesIO

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import MESSAGES, Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.merged import MessageIn
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.with_state import SessionWithState
from igtl_gateway.record.sessionfile.writer import packed_session
from igtl_gateway.replay.latched import part_of_session
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.source import through_gateway

#: Notes that are written once and hold until the end of a session: of names, and of messages that are changed.
LASTING = frozenset(
    "frame_renamed frame_shared name_shared name_cut not_a_rotation not_a_pose text_cut encoding_changed adapted "
    "field_left_out direction_not_unit uint32_as_float64 deviation_read coordinate_zero cell_scalars "
    "trajectory_not_drawn float32_attribute colours_left_out unknown_status empty no_conversion shown_instead "
    "arm_unit not_for_peer".split()
)
_MESSAGES = frozenset(kind.value for kind in MESSAGES)
#: Latched topics of ROS, for recordings whose prologue has no quality of service: the ends of their names.
_LATCHED_TOPICS = ("/tf_static", "/robot_description")


def with_state(file: SessionFile) -> SessionFile:
    """Return the file with the latched messages and lasting notes from before it; the same file if there are none.

    Latched are ROS topics with transient-local durability, the OpenIGTLink types that are a state and not a sample, and
    what the gateway made of them.  The caller closes only the file that it has opened.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is None or not (entries := _state(file, before, config_to_run(file.session))):
        return file
    qos = {(each.topic, each.type): each.qos for each in (*before.channels, *file.channels) if each.qos}
    data = packed_session(
        entries,
        lambda topic, ros_type: qos.get((topic, ros_type)),
        lambda ros_type: file.definition_of(ros_type) or before.definition_of(ros_type),
    )
    return SessionWithState(file, SessionFile(file.path, BytesIO(data)))


def latched_before(file: SessionFile, config: Config) -> Iterator[Entry]:
    """Yield lasting notes and latched messages from before a file, and what the gateway made of them, in their order.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is not None:
        yield from _state(file, before, config)


def messages_before(file: SessionFile) -> Iterator[MessageIn]:
    """Yield the latched messages from before a file, as its own of ``SessionFile.messages``, at their times.

    Raises DamagedRecording.
    """
    whole = with_state(file)
    if isinstance(whole, SessionWithState):
        yield from whole.before.messages(lambda channel: channel.metadata.get(layout.KIND_KEY) in _MESSAGES)


def notes_before(file: SessionFile) -> list[Entry]:
    """Return the lasting notes from before a file.  Raises DamagedRecording."""
    before = file.prologue_file()
    return [] if before is None else _split(_before(before, config_to_run(file.session)))[0]


def _state(file: SessionFile, before: SessionFile, config: Config) -> list[Entry]:
    """The lasting notes and the latched messages of a prologue."""
    latched = {(each.topic, each.type) for each in (*before.channels, *file.channels) if each.qos and each.qos.latched}

    def is_latched(topic: str, ros_type: str) -> bool:
        return (topic, ros_type) in latched or topic.endswith(_LATCHED_TOPICS)

    notes, entries = _split(_before(before, config))
    return [*notes, *part_of_session(entries, file.start_ns, None, is_latched)]


def _before(before: SessionFile, config: Config) -> Iterator[Entry]:
    """The inputs of a prologue, and what the gateway makes of them."""
    has_links = any(each.kind is Kind.LINK for each in before.channels)
    return through_gateway((), config, has_links=has_links, before=before.entries())


def _split(entries: Iterable[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Lasting notes, and all entries but notes."""
    notes, others = [], []
    for entry in entries:
        if entry.kind is not Kind.NOTE:
            others.append(entry)
        elif Note.of(entry.data()).code in LASTING:
            notes.append(entry)
    return notes, others


def without_state(file: SessionFile) -> SessionFile:
    """Return the file itself, without what :func:`with_state` has added."""
    return file.itself if isinstance(file, SessionWithState) else file
