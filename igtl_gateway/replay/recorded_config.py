"""The configuration that a recording is replayed, verified and compared with."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from igtl_gateway.base.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.expected import PresentSources, expected_sources, missing_sources
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.stream_units import StreamUnits, arm_units, arm_units_before
from igtl_gateway.record.sessionfile import facts
from igtl_gateway.record.sessionfile.reader import SessionFile


class RecordedStream(Protocol):
    """A stream of a recording; see ``sessionfile.channels.ChannelSummary``."""

    @property
    def kind(self) -> Kind: ...
    @property
    def stream(self) -> str: ...
    @property
    def entry_type(self) -> str: ...


class RecordedSession(Protocol):
    """What the units of a recording depend on; see ``sessionfile.reader.SessionFile``."""

    @property
    def session(self) -> Mapping[str, str]: ...
    @property
    def channels(self) -> Sequence[RecordedStream]: ...
    def entries_of_kinds(self, kinds: Collection[Kind]) -> Iterator[Entry]: ...
    def prologue(self) -> list[Entry]: ...


def config_to_run(session: Mapping[str, str], path: Path | None = None) -> Config:
    """Return the configuration of the file ``path`` if it is given, else the recorded one.

    Raises ConfigError for an invalid file, UnsupportedRecording if the recorded configuration cannot be used.
    """
    given = Config.from_toml(path) if path else None
    try:
        recorded = Config.from_dict(facts.configuration(session))
        # without a setting in the file for what is older than a recording, the recorded setting applies
        return given.as_live_as(recorded) if given else recorded
    except (ConfigError, DamagedRecording) as error:
        if given:
            return given
        raise UnsupportedRecording(f"the recorded configuration cannot be used: {error}") from None


def absent_sources(file: SessionFile, config: Config) -> list[str]:
    """Return a sentence about each topic, arm and device of a configuration that a recording does not have."""
    received = [each for each in file.channels if each.count and each.kind in (Kind.ROS_IN, Kind.IGTL_IN)]
    topics = {each.topic for each in received if each.kind is Kind.ROS_IN}
    streams = {each.stream for each in received if each.kind is Kind.IGTL_IN}
    # streams that share a channel of a file have no name before they are read
    devices = {name.partition("/")[2] for name in streams} if all(streams) else None
    return [each.text for each in missing_sources(expected_sources(config), PresentSources(topics, None, devices))]


def recorded_units(file: RecordedSession) -> StreamUnits:
    """Return the units of the streams of a recording: the default ones where it has no usable configuration."""
    return units_of(_recorded(file), file)


def recorded_acceptance(file: RecordedSession) -> Acceptance:
    """Return which bytes the session of a recording accepted as messages: as ``recorded_units``."""
    return Acceptance.of(_recorded(file))


def _recorded(file: RecordedSession) -> Config:
    try:
        return Config.from_dict(facts.configuration(file.session))
    except (ConfigError, DamagedRecording):
        return Config()


def units_of(config: Config, file: RecordedSession) -> StreamUnits:
    """Return the units of the streams of a recording, by another configuration."""
    streams = ((each.kind, each.stream, each.entry_type) for each in file.channels if each.stream)
    return StreamUnits(config, streams, peer_units(config, file))


def peer_units(config: Config, file: RecordedSession) -> dict[int, str]:
    """Return link → unit of arms, of the peers of a recording with a unit of their own."""
    if not (config.all_arms and config.fitting):  # only then do notes state the unit of a peer
        return {}
    return arm_units_before(config, file.prologue()) | arm_units(file.entries_of_kinds({Kind.NOTE}))
