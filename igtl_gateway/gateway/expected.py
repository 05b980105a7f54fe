"""The sources that a configuration names: topics and arms of ROS, frames, devices of peers, streams to record.

A name with a mistake selects nothing, which looks like a source that is off.  So a source that does not come is
reported, with the nearest name that exists.  Names with wildcards expect nothing, except those of what is recorded: if
they match nothing, nothing is.  What is allowed or left out need not come, so it is reported only beside a near name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import did_you_mean, near_names
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import KINDS, Trigger
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.gateway.log.note import Level, Note

#: Code of the note about a source that has not come.
NO_SOURCE = "no_source"

SourceKind = Literal["topic", "arm", "frame", "device", "stream"]
#: Kind → what is missing, and where.
_ABSENT: dict[SourceKind, str] = {
    "topic": "no node publishes it",
    "arm": "no node publishes a topic of it",
    "frame": "it is not on /tf or /tf_static",
    "device": "no peer sends it",
    "stream": "no stream has this name",
}

#: What the pattern of a trigger is compared with → kind; a stream need not come for its losses to be waited for.
_OF_TRIGGERS: dict[str, SourceKind] = {"device": "device", "stream": "stream"}


@dataclass(frozen=True, slots=True)
class ExpectedSource:
    """A source that a setting names.

    Attributes:
        kind: what it is.
        name: topic, name space of an arm, frame or device.
        setting: the setting that names it.
        is_optional: whether it need not come: it is missed only if something with a near name is there.
    """

    kind: SourceKind
    name: str
    setting: str
    is_optional: bool = False


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
        streams: all topics, ``TYPE/device`` and devices of both sides; None: not known, or there is none.
    """

    topics: Collection[str] | None = None
    frames: Collection[str] | None = None
    devices: Collection[str] | None = None
    streams: Collection[str] | None = None

    def names(self, kind: SourceKind) -> Collection[str] | None:
        """Return the names of a kind, of arms the name spaces of the topics; None if they are not known."""
        if kind == "arm":
            return None if self.topics is None else {topic.rpartition("/")[0] for topic in self.topics}
        return {"topic": self.topics, "frame": self.frames, "device": self.devices, "stream": self.streams}[kind]


def expected_sources(
    config: Config,
    recorded: Iterable[str] = (),
    included: Iterable[str] = (),
    excluded: Iterable[str] = (),
    triggers: Iterable[Trigger] = (),
    classed: Iterable[str] = (),
) -> list[ExpectedSource]:
    """Return the sources that a configuration names.

    Args:
        config: the configuration.
        recorded: topics that are recorded in addition.
        included, excluded: globs of the streams that are recorded only, and that are not.
        triggers: rules of the black box.
        classed: globs of the topics with a class on the line between sites.
    """
    found = [ExpectedSource("topic", row.topic, f"to_igtl[{at}]") for at, row in enumerate(config.to_igtl)]
    for at, request in enumerate(row.request() for row in config.tf_out):
        frames = (*request.frames, request.base)
        found += [ExpectedSource("frame", frame_id(frame), f"tf_out[{at}]") for frame in frames]
    found += [ExpectedSource("arm", row.arms, f"crtk[{at}]") for at, row in enumerate(config.crtk)]
    found += [ExpectedSource("device", row.device, f"to_ros[{at}]") for at, row in enumerate(config.to_ros)]
    found += [each for rule in triggers for each in _of_a_trigger(rule)]
    found += [ExpectedSource("topic", topic, "--record-topics") for topic in recorded]
    found += [ExpectedSource("device", device, "mark_from", is_optional=True) for device in config.mark_from]
    found += [ExpectedSource("device", device, "allow_in", is_optional=True) for device in config.allow_in]
    found += [ExpectedSource("topic", f"/{device}", "allow_out", is_optional=True) for device in config.allow_out]
    found += [ExpectedSource("stream", glob, "--record-exclude", is_optional=True) for glob in excluded]
    found = [each for each in found if not set("*?") & set(each.name)]
    found += [ExpectedSource("stream", glob, "--record-include") for glob in included]
    found += [ExpectedSource("stream", glob, "--site-class") for glob in classed]
    # of several settings with one name, the first one
    return list(reversed({(each.kind, each.name): each for each in reversed(found)}.values()))


def _of_a_trigger(rule: Trigger) -> list[ExpectedSource]:
    """Return what a rule looks at, if it names it."""
    row = KINDS[rule.kind]
    if row.is_topic:
        return [ExpectedSource("topic", rule.pattern, "--trigger")]
    kind = _OF_TRIGGERS.get(row.matched)
    return [ExpectedSource(kind, rule.pattern, "--trigger", is_optional=kind == "stream")] if kind else []


def missing_sources(expected: Iterable[ExpectedSource], present: PresentSources) -> list[MissingSource]:
    """Return the expected sources that are not there, of the kinds that are known."""
    found = []
    for source in expected:
        names = present.names(source.kind)
        if names is None or _is_there(source, names):
            continue
        near = near_names(source.name, sorted(set(names)), 0.7)[:1]
        if source.is_optional and not near:
            continue
        question = did_you_mean(near)
        text = f"{source.name} is configured ({source.setting}), but {_ABSENT[source.kind]}"
        found.append(MissingSource(source, f"{text}; {question}" if question else text))
    return found


def _is_there(source: ExpectedSource, names: Collection[str]) -> bool:
    """Return whether a source is among the names; the topics of an arm may be some levels below its name."""
    name = source.name
    if source.kind == "stream":
        return any(matches(name, each) for each in names)
    return name in names or (source.kind == "arm" and any(each.startswith(f"{name}/") for each in names))
