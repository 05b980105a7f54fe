"""The sources that a configuration names: topics and arms of ROS, frames, devices and addresses of peers, streams.

A name with a mistake selects nothing, which looks like a source that is off.  So a source that does not come is
reported, with the nearest name that exists.  One table, ``SOURCES``, has each setting that names a source; another one
the settings that name none, so that a new setting is in one of them.

Of a name with wildcards one match is enough, and one that matches everything expects nothing.  What is allowed or left
out need not come, so it is reported only beside a near name.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import did_you_mean, nearest_name
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import KINDS, Trigger
from igtl_gateway.convert.arms import arms_of_profile
from igtl_gateway.convert.crtk import namespaces
from igtl_gateway.convert.exchanges import IN_ACTION, SERVICE_EVENT
from igtl_gateway.convert.frames import frame_id
from igtl_gateway.convert.igtl_msgs import RawMessage
from igtl_gateway.convert.table import row_to_igtl
from igtl_gateway.gateway.log.note import Level, Note

#: Codes of the notes about a source that has not come, and about one that was reported and has come now.
NO_SOURCE, SOURCE_CAME = "no_source", "source_came"

SourceKind = Literal["topic", "arm", "frame", "device", "stream", "link", "peer"]
#: Kind → what is missing where the name itself is.
_ABSENT: dict[SourceKind, str] = {
    "topic": "no publisher",
    "arm": "no publisher below it",
    "frame": "not on /tf or /tf_static",
    "device": "no peer sends it",
    "stream": "no stream has this name",
    "link": "no answer",
    "peer": "no such peer",
}
#: Kinds whose sources come from peers.
OF_PEERS = frozenset({"device", "stream"})
#: Kinds whose sources leave visibly: the others are known by what has come from them.
LEAVING = frozenset({"topic", "arm", "link"})

_WILD = "*?"
_EVERYWHERE = ("0.0.0.0", "[::]", "::")


@dataclass(frozen=True, slots=True)
class SourceKey:
    """A setting that names sources.

    Attributes:
        setting: its name; of a table of rows, the name of the table.
        field: of a table: the field with the name.
        kind: what it names.
        types: of a table: the field with the type of OpenIGTLink that the source has, or "".
        is_optional: whether it need not come: it is missed only if something with a near name is there.
        option: how the text calls it, if not by its name.
    """

    setting: str
    field: str
    kind: SourceKind
    types: str = ""
    is_optional: bool = False
    option: str = ""


#: Each setting that names a source.
SOURCES: tuple[SourceKey, ...] = (
    SourceKey("to_igtl", "topic", "topic", types="type"),
    SourceKey("tf_out", "frames", "frame"),
    SourceKey("tf_out", "base", "frame"),
    SourceKey("crtk", "arms", "arm"),
    SourceKey("profile", "", "arm"),
    SourceKey("to_ros", "device", "device", types="type"),
    SourceKey("trigger", "", "stream", option="--trigger"),
    SourceKey("record_topics", "", "topic", option="--record-topics"),
    SourceKey("mark_from", "", "device", is_optional=True),
    SourceKey("allow_in", "", "device", is_optional=True),
    SourceKey("allow_out", "", "topic", is_optional=True),
    SourceKey("record_exclude", "", "stream", is_optional=True, option="--record-exclude"),
    SourceKey("record_include", "", "stream", option="--record-include"),
    SourceKey("site_classes", "", "stream", option="--site-class"),
    SourceKey("connect", "", "link"),
    SourceKey("peers", "at", "peer"),
    SourceKey("clock_from", "", "peer", option="--clock-from"),
)

#: What the pattern of a trigger is compared with → kind; a stream need not come for its losses to be waited for.
_OF_TRIGGERS: dict[str, SourceKind] = {"device": "device", "stream": "stream"}


@dataclass(frozen=True, slots=True)
class ExpectedSource:
    """A source that a setting names.

    Attributes:
        kind: what it is.
        name: topic, name space of an arm, frame, device, stream or address; a glob, except for frames and links.
        setting: the setting that names it.
        is_optional: whether it need not come: it is missed only if something with a near name is there.
        type: type of OpenIGTLink, of a device a glob of types; "": any.
    """

    kind: SourceKind
    name: str
    setting: str
    is_optional: bool = False
    type: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class MissingSource:
    """A source that is not there.

    Attributes:
        source: the source.
        why: what is missing, in a few words.
        near: the nearest name that is there; "" if none is near.
        is_there: whether it is there, and nothing can come from it.
    """

    source: ExpectedSource
    why: str
    near: str = ""
    is_there: bool = False

    @property
    def text(self) -> str:
        """A sentence for people, with a near name that is there."""
        question = did_you_mean([self.near]) if self.near else ""
        source = self.source
        return f"{source.kind} {source.name}: {'; '.join(filter(None, (self.why, question)))} ({source.setting})"

    def note(self) -> Note:
        """Return the note about it."""
        return Note(Level.WARN, NO_SOURCE, self.text, self.source.name, self._data())

    def arrival(self) -> Note:
        """Return the note that it has come."""
        source = self.source
        text = f"{source.kind} {source.name}: now arrives ({source.setting})"
        return Note(Level.INFO, SOURCE_CAME, text, source.name, self._data())

    def _data(self) -> dict[str, str]:
        return {"kind": self.source.kind, "setting": self.source.setting}

    def to_dict(self) -> dict[str, str]:
        """Return it as JSON values, for a page."""
        source = self.source
        facts = {"name": source.name, "kind": source.kind, "setting": source.setting}
        return facts | {"why": self.why, "near": self.near, "text": self.text}


#: Names, or name → the types that it has, of ROS for topics and of OpenIGTLink for devices.
Names = Collection[str] | Mapping[str, Collection[str]]


@dataclass(frozen=True, slots=True)
class PresentSources:
    """What is there; None: not known.

    Attributes:
        topics: topics of ROS with a publisher of another node.
        frames: frames of /tf and /tf_static.
        devices: devices of the messages from peers.
        streams: all topics, ``TYPE/device`` and devices of both sides.
        links: addresses of the servers that are connected.
        peers: addresses at which peers are or may come.
        connected: number of connected peers.
        clashes: topic → why nothing passes from its publishers, although they are there.
        apart: frame → the base that no transform connects it with.
    """

    topics: Names | None = None
    frames: Names | None = None
    devices: Names | None = None
    streams: Names | None = None
    links: Collection[str] | None = None
    peers: Collection[str] | None = None
    connected: int | None = None
    clashes: Mapping[str, str] = field(default_factory=dict)
    apart: Mapping[str, str] = field(default_factory=dict)

    def names(self, kind: SourceKind) -> Names | None:
        """Return the names of a kind, of arms the name spaces of the topics; None if they are not known."""
        if kind == "arm":
            if self.topics is None:
                return None
            return {place for topic in self.topics for place in namespaces(topic.lstrip("/"))}
        return {
            "topic": self.topics,
            "frame": self.frames,
            "device": self.devices,
            "stream": self.streams,
            "link": self.links,
            "peer": self.peers,
        }[kind]


def expected_sources(
    config: Config,
    recorded: Iterable[str] = (),
    included: Iterable[str] = (),
    excluded: Iterable[str] = (),
    triggers: Iterable[Trigger] = (),
    classed: Iterable[str] = (),
    connect: Iterable[str] = (),
    clock_from: Iterable[str] = (),
) -> list[ExpectedSource]:
    """Return the sources that a configuration names.

    Args:
        config: the configuration.
        recorded: topics that are recorded in addition.
        included, excluded: globs of the streams that are recorded only, and that are not.
        triggers: rules of the black box.
        classed: globs of the topics with a class on the line between sites.
        connect: addresses of the servers that are connected to.
        clock_from: globs of the addresses of peers that are asked for their clock.
    """
    given: dict[str, Iterable[Any]] = {
        "record_topics": recorded,
        "record_include": included,
        "record_exclude": excluded,
        "trigger": triggers,
        "site_classes": classed,
        "connect": connect,
        "clock_from": clock_from,
    }
    found: dict[tuple[SourceKind, str], ExpectedSource] = {}  # of several settings with one name, the first one
    for key in SOURCES:
        for each in _named_by(key, config, given):
            if _expects(each):
                found.setdefault((each.kind, each.name), each)
    return list(found.values())


def _named_by(key: SourceKey, config: Config, given: Mapping[str, Iterable[Any]]) -> Iterator[ExpectedSource]:
    """Yield the sources that a setting names."""
    if key.setting == "trigger":
        yield from (each for rule in given["trigger"] for each in _of_a_trigger(rule, key.option))
        return
    names: Iterable[Any]
    if key.setting == "profile":
        names = filter(None, [arms_of_profile(config.profile)])
    elif key.field:
        for at, row in enumerate(getattr(config, key.setting)):
            whole = row.request() if key.setting == "tf_out" else row
            value, kind_of = getattr(whole, key.field), str(getattr(whole, key.types)) if key.types else ""
            for name in [value] if isinstance(value, str) else value:
                plain = frame_id(name) if key.kind == "frame" else name
                yield ExpectedSource(key.kind, plain, f"{key.setting}[{at}]", type=kind_of)
        return
    else:
        names = given.get(key.setting, getattr(config, key.setting, ()))
    slash = "/" if key.setting == "allow_out" else ""  # commands of arms are named as devices
    yield from (
        ExpectedSource(key.kind, f"{slash}{name}", key.option or key.setting, key.is_optional) for name in names
    )


def _expects(source: ExpectedSource) -> bool:
    """Return whether a name expects something: not one that matches everything, or need not come and has wildcards."""
    if source.kind in ("frame", "link"):
        return True
    return bool(source.name.strip("*?/:")) and not (source.is_optional and _is_wild(source))


def _is_wild(source: ExpectedSource) -> bool:
    return source.kind not in ("frame", "link") and bool(set(_WILD) & set(source.name))


def _of_a_trigger(rule: Trigger, option: str) -> list[ExpectedSource]:
    """Return what a rule looks at, if it names it."""
    row = KINDS[rule.kind]
    if rule.pattern == row.pattern:
        return []
    if row.expected:
        return [ExpectedSource("topic", row.expected.format(rule.pattern), option)]
    kind = _OF_TRIGGERS.get(row.matched)
    return [ExpectedSource(kind, rule.pattern, option, is_optional=kind == "stream")] if kind else []


def missing_sources(expected: Iterable[ExpectedSource], present: PresentSources) -> list[MissingSource]:
    """Return the expected sources that are not there, of the kinds that are known."""
    found = []
    for source in expected:
        names = present.names(source.kind)
        if names is None or not is_known(source, present):
            continue
        there = [name for name in names if _is_name_of(source, name)]
        if there:
            if why := _unfit(source, there, names, present):
                found.append(MissingSource(source, why, is_there=True))
            continue
        near = _hidden_name(source.name, names) or nearest_name(source.name.strip(_WILD), names)
        if source.is_optional and not near:
            continue
        found.append(MissingSource(source, _absence(source, present), near))
    return found


def is_known(source: ExpectedSource, present: PresentSources) -> bool:
    """Return whether it can be seen if a source is there: an address of connected peers only if there are any."""
    names = present.names(source.kind)
    if names is None or source.kind != "peer" or not _is_wild(source) or present.connected:
        return names is not None
    return any(_is_name_of(source, name) for name in names)


def _hidden_name(name: str, names: Names) -> str:
    """Return the topics of a service or an action that is named itself; ``""`` of other names."""
    if (events := f"{name}{SERVICE_EVENT}") in names:
        return events
    return f"{name}{IN_ACTION}**" if any(each.startswith(f"{name}{IN_ACTION}") for each in names) else ""


def _is_name_of(source: ExpectedSource, name: str) -> bool:
    """Return whether a name is that of a source."""
    if source.kind in ("frame", "link"):
        return name == source.name
    if source.kind == "peer":
        host, _, port = name.rpartition(":")
        if host in _EVERYWHERE and source.name.rpartition(":")[2] == port:
            return True
    return matches(source.name, name)


def _absence(source: ExpectedSource, present: PresentSources) -> str:
    """Return what is missing of a source of which nothing is there."""
    if source.kind in OF_PEERS and not present.names(source.kind) and present.connected is not None:
        return "no peer sends anything" if present.connected else "no peer is connected"
    if source.kind == "topic" and source.name.endswith(SERVICE_EVENT):
        return "no publisher: the service is not there, or its introspection is off"
    return _ABSENT[source.kind]


def _unfit(source: ExpectedSource, there: Collection[str], names: Names, present: PresentSources) -> str:
    """Return why nothing comes from a source that is there; "": it comes."""
    if source.kind == "frame":
        base = present.apart.get(source.name)
        return f"no transform connects it with {base}" if base else ""
    types = {name: names[name] for name in there if isinstance(names, Mapping)}
    unfit = {name: why for name in there if (why := _type_clash(source, types.get(name, ())))}
    unfit |= {name: present.clashes[name] for name in there if source.kind == "topic" and name in present.clashes}
    return next(iter(unfit.values())) if len(unfit) == len(there) else ""


def _type_clash(source: ExpectedSource, types: Collection[str]) -> str:
    """Return why no type of a topic or device is that of its row; "": one is, or none is known."""
    if not types or not source.setting.startswith(("to_igtl", "to_ros")):
        return ""
    found = " and ".join(sorted(types)[:2])
    if source.kind == "device":
        fits = source.type in ("", "**") or any(matches(source.type, each) for each in types)
        return "" if fits else f"it is {found}, expected {source.type}"
    if source.type == "VIDEO" or any(_converts(each, source.type) for each in types):
        return ""
    return f"{found} has no conversion{f' to {source.type}' if source.type else ''}"


def _converts(ros_type: str, igtl_type: str) -> bool:
    return ros_type == RawMessage.TYPE or row_to_igtl(ros_type, igtl_type) is not None
