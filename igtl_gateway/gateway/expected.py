"""The sources that a configuration names: topics and arms of ROS, frames, devices of peers.

A name with a mistake selects nothing, which looks like a source that is off.  So a source that does not come is
reported, with the nearest name that exists.  Names with wildcards expect nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.gateway.log.note import Level, Note

#: Code of the note about a source that has not come.
NO_SOURCE = "no_source"

SourceKind = Literal["topic", "arm", "frame", "device"]
#: Kind → what is missing, and where.
_ABSENT: dict[SourceKind, str] = {
    "topic": "no node publishes it",
    "arm": "no node publishes a topic of it",
    "frame": "it is not on /tf or /tf_static",
    "device": "no peer sends it",
}


@dataclass(frozen=True, slots=True)
class ExpectedSource:
    """A source that a setting names.

    Attributes:
        kind: what it is.
        name: topic, name space of an arm, frame or device.
        setting: the setting that names it.
    """

    kind: SourceKind
    name: str
    setting: str


@dataclass(frozen=True, slots=True)
class MissingSource:
    """A source that is not there.

    Attributes:
        source: the source.
        text: a sentence for people, with a near name that is there.
    """

    source: ExpectedSource
    text: str

    def note(self) -> Note:
        """Return the note about it."""
        source = self.source
        data = {"kind": source.kind, "setting": source.setting}
        return Note(Level.WARN, NO_SOURCE, self.text, source.name, data)


@dataclass(frozen=True, slots=True)
class PresentSources:
    """What is there.

    Attributes:
        topics: topics of ROS with a publisher of another node; None: not known.
        frames: frames of /tf and /tf_static; None: not known.
        devices: devices of the messages from peers; None: not known, or no peer has sent anything.
    """

    topics: Collection[str] | None = None
    frames: Collection[str] | None = None
    devices: Collection[str] | None = None

    def names(self, kind: SourceKind) -> Collection[str] | None:
        """Return the names of a kind, of arms the name spaces of the topics; None if they are not known."""
        if kind == "arm":
            return None if self.topics is None else {topic.rpartition("/")[0] for topic in self.topics}
        return {"topic": self.topics, "frame": self.frames, "device": self.devices}[kind]


def expected_sources(config: Config, recorded: Iterable[str] = ()) -> list[ExpectedSource]:
    """Return the sources that a configuration names.

    Args:
        config: the configuration.
        recorded: topics that are recorded in addition.
    """
    found = [ExpectedSource("topic", row.topic, f"to_igtl[{at}]") for at, row in enumerate(config.to_igtl)]
    for at, request in enumerate(row.request() for row in config.tf_out):
        frames = (*request.frames, request.base)
        found += [ExpectedSource("frame", frame_id(frame), f"tf_out[{at}]") for frame in frames]
    found += [ExpectedSource("arm", row.arms, f"crtk[{at}]") for at, row in enumerate(config.crtk)]
    found += [ExpectedSource("device", row.device, f"to_ros[{at}]") for at, row in enumerate(config.to_ros)]
    found += [ExpectedSource("topic", topic, "--record-topics") for topic in recorded]
    # of several settings with one name, the first one
    exact = {(each.kind, each.name): each for each in reversed(found) if not set("*?") & set(each.name)}
    return list(reversed(exact.values()))


def missing_sources(expected: Iterable[ExpectedSource], present: PresentSources) -> list[MissingSource]:
    """Return the expected sources that are not there, of the kinds that are known."""
    found = []
    for source in expected:
        names = present.names(source.kind)
        if names is None or _is_there(source, names):
            continue
        near = near_names(source.name, sorted(set(names)), 0.7)[:1]
        question = did_you_mean(near)
        text = f"{source.name} is configured ({source.setting}), but {_ABSENT[source.kind]}"
        found.append(MissingSource(source, f"{text}; {question}" if question else text))
    return found


def _is_there(source: ExpectedSource, names: Collection[str]) -> bool:
    """Return whether a source is among the names; the topics of an arm may be some levels below its name."""
    name = source.name
    return name in names or (source.kind == "arm" and any(each.startswith(f"{name}/") for each in names))
