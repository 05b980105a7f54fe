"""A part of a session with the state before it, for readers of messages.

A part of a split recording, and a snapshot, begin midway: static transforms, the description of a robot, plans and
surfaces may have been sent long before.  The prologue has them, so that the gateway can go on from there.  Here they
are the first messages of the part, at their recorded times, as in a slice.
"""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.with_state import SessionWithState
from igtl_gateway.record.sessionfile.writer import packed_session
from igtl_gateway.replay.latched import part_of_session
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.source import through_gateway

#: Latched topics of ROS, for recordings whose prologue has no quality of service: the ends of their names.
_LATCHED_TOPICS = ("/tf_static", "/robot_description")


def with_state(file: SessionFile) -> SessionFile:
    """Return the file with the latched messages from before it; the same file if there are none.

    Latched are ROS topics with transient-local durability, the OpenIGTLink types that are a state and not a sample, and
    what the gateway made of them.  The caller closes only the file that it has opened.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is None or not (entries := list(_latched(file, before, config_to_run(file.session)))):
        return file
    qos = {(each.topic, each.type): each.qos for each in (*before.channels, *file.channels) if each.qos}
    data = packed_session(
        entries,
        lambda topic, ros_type: qos.get((topic, ros_type)),
        lambda ros_type: file.definition_of(ros_type) or before.definition_of(ros_type),
    )
    return SessionWithState(file, SessionFile(file.path, BytesIO(data)))


def latched_before(file: SessionFile, config: Config) -> Iterator[Entry]:
    """Yield the latched messages from before a file, and what the gateway made of them, in their order.

    Raises DamagedRecording.
    """
    before = file.prologue_file()
    if before is not None:
        yield from _latched(file, before, config)


def _latched(file: SessionFile, before: SessionFile, config: Config) -> Iterator[Entry]:
    latched = {(each.topic, each.type) for each in (*before.channels, *file.channels) if each.qos and each.qos.latched}

    def is_latched(topic: str, ros_type: str) -> bool:
        return (topic, ros_type) in latched or topic.endswith(_LATCHED_TOPICS)

    has_links = any(each.kind is Kind.LINK for each in before.channels)
    entries = through_gateway((), config, has_links=has_links, before=before.entries())
    yield from part_of_session(entries, file.start_ns, None, is_latched)


def without_state(file: SessionFile) -> SessionFile:
    """Return the file itself, without what :func:`with_state` has added."""
    return file.itself if isinstance(file, SessionWithState) else file
