"""Configuration: frozen values from a TOML file or from a recording, checked when they are made.

Everything that influences what the gateway says is here, and is stored in the recording: replay and
verification use what was in force that day.

::

    [gateway]
    base_frame = "igtl"            # frame of all that names no frame of its own
    ros_unit = "m"                 # m, dm, cm, mm, um
    igtl_unit = "mm"
    stamp = "source"               # source: the sender's stamp, else the gateway's; receive: the gateway's
    check_crc = true
    profile = "auto"               # what the peers are: slicer, plus …; auto: by what they show
    publish_tf = true              # poses appear on /tf too
    command_timeout_s = 5.0        # a COMMAND without a reply is given up
    relay = false                  # true: no bridge; peers and a server talk through us, bytes unchanged
    faults = ""                    # of a relay, on purpose: "delay=50ms,in:loss=1%", see docs/faults.md
    fault_seed = 0                 # which messages they hit
    deny_in = []                   # types that peers may not send, such as ["COMMAND", "TRANSFORM"] or ["*"]
    deny_out = []                  # types that peers are not sent
    watch = true                   # say what looks odd: units that jump, stamps that run back; live only unless set

    [[to_igtl]]                    # ROS topic → OpenIGTLink; the first row that matches counts
    topic = "/camera/image_raw"    # * stands for one level, ** for any number
    device = "Camera"              # default: from the topic
    type = "IMAGE"                 # default: by the conversion table
    max_age_s = 0.5                # what is older on arrival is not sent; default 0: whatever its age

    [[to_ros]]                     # OpenIGTLink → ROS
    device = "Probe*"
    topic = "/probe/{device}/{kind}"
    frame_id = "tracker"
    max_age_s = 0.5                # as above
    kinds = ["+slices"]            # messages on request besides the usual ones; without +: only these

    [[tf_out]]                     # frames of /tf and /tf_static → OpenIGTLink, chains composed
    frames = ["tool"]
    base = "base_link"
    device = "Tool"                # default: toolTobase_link
    max_age_s = 0.5                # as above; of a chain its oldest transform counts

    [[peers]]                      # which peer is what
    at = "127.0.0.1:18945"         # its address, or the one that it connects to
    profile = "plus"

    [igtl]                         # the OpenIGTLink side of a bridge, see ``cli.edge_file``: no part of a session
    listen = ["127.0.0.1:18944"]

Rows may override ros_unit, igtl_unit, stamp and, as ``qos = { depth = 10, reliable = true, latched = false }``,
the quality of service.  Without any row, what a device sends appears on ``/igtl/in/<device>/<kind>`` and what
is published below ``/igtl/out/`` goes out.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from typing import Any, TypeVar

from igtl_gateway.convert.frames import TfRequest
from igtl_gateway.convert.profiles import AUTO, BY_NAME
from igtl_gateway.convert.table import TO_IGTL
from igtl_gateway.convert.units import UNITS, LengthUnits
from igtl_gateway.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.faults import RelayFaults
from igtl_gateway.globs import matches
from igtl_gateway.qos import Qos
from igtl_gateway.untrusted.files import read_bytes
from igtl_gateway.untrusted.text import parse_toml

#: Which time is the stamp of a converted message: the sender's, if it sent one, or the time of receipt.
SOURCE, RECEIVE = "source", "receive"
STAMP_POLICIES = (SOURCE, RECEIVE)
#: Other names of the policies, for the configurations of old recordings.
_STAMP_ALIASES = {"now": RECEIVE}
OUT_PREFIX = "/igtl/out/"
IN_TOPIC = "/igtl/in/{device}/{kind}"

#: Streams that one session may open in each direction: a peer that invents names must not fill the ROS graph.
DEFAULT_MAX_STREAMS = 512

#: Values of the setting ``profile``.
PROFILE_NAMES = (AUTO, *BY_NAME)

#: A COMMAND that takes longer than a day has no reply.
MAX_TIMEOUT_S = 86_400.0

#: Longest age that can be asked for: of a year; what is older than that has no clock.
MAX_AGE_S = 365 * 86_400.0

#: Deepest queue of a ROS stream: beyond it a slow reader costs memory without end.
MAX_DEPTH = 100_000


@dataclass(frozen=True, slots=True)
class _Row:
    """What the rows of both directions have in common; "" and None stand for the gateway's setting."""

    ros_unit: str = ""
    igtl_unit: str = ""
    stamp: str = ""
    qos: Qos | None = None


@dataclass(frozen=True, slots=True)
class ToIgtlRow(_Row):
    """A ROS topic (pattern) on its way to OpenIGTLink; ``metadata`` goes along to peers of header version 2."""

    topic: str = OUT_PREFIX + "**"
    device: str = ""
    type: str = ""
    metadata: tuple[tuple[str, str], ...] = ()
    max_age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class ToRosRow(_Row):
    """OpenIGTLink devices (pattern) on their way to ROS; ``kinds`` chooses among the messages that they become."""

    device: str = "**"
    type: str = "**"
    topic: str = IN_TOPIC
    frame_id: str = ""
    child_frame_id: str = ""
    kinds: tuple[str, ...] = ()
    max_age_s: float = 0.0


@dataclass(frozen=True, slots=True)
class TfOutRow(_Row):
    """Frames of the tf tree on their way to OpenIGTLink, as seen from ``base``."""

    frames: tuple[str, ...] = ()
    base: str = ""
    device: str = ""
    type: str = ""
    max_age_s: float = 0.0

    def request(self, place: str = "tf_out") -> TfRequest:
        """What is asked of the tf tree.  Raises ConfigError, naming ``place``."""
        try:
            request = TfRequest.parse(f"{','.join(self.frames)}:{self.base}")
            return dataclasses.replace(request, device=self.device or request.device, type=self.type or request.type)
        except ConfigError as error:
            raise ConfigError(f"{place}: {error}") from None


@dataclass(frozen=True, slots=True)
class PeerRow:
    """What the peers at an address (pattern) are."""

    at: str = "**"
    profile: str = AUTO


@dataclass(frozen=True, slots=True)
class Config:
    """The configuration of a session; see the module for the meaning of each setting.

    ``watch`` adds notes.  Where it is not set (None) there are none: so it was in recordings from before there was this
    setting.  Live sessions set it; see ``watched``.
    """

    base_frame: str = "igtl"
    ros_unit: str = "m"
    igtl_unit: str = "mm"
    stamp: str = SOURCE
    check_crc: bool = True
    max_streams: int = DEFAULT_MAX_STREAMS
    profile: str = AUTO
    publish_tf: bool = True
    command_timeout_s: float = 5.0
    relay: bool = False
    faults: str = ""
    fault_seed: int = 0
    deny_in: tuple[str, ...] = ()
    deny_out: tuple[str, ...] = ()
    watch: bool | None = None
    to_igtl: tuple[ToIgtlRow, ...] = ()
    to_ros: tuple[ToRosRow, ...] = ()
    tf_out: tuple[TfOutRow, ...] = ()
    peers: tuple[PeerRow, ...] = ()

    def __post_init__(self) -> None:
        _check_choices("gateway", self, optional=False)
        if not 0 < self.command_timeout_s < MAX_TIMEOUT_S:
            found = f"{self.command_timeout_s:g}"
            raise ConfigError(f"gateway.command_timeout_s: found {found}, expected above 0 and below {MAX_TIMEOUT_S:g}")
        if RelayFaults.parse(self.faults, "gateway.faults") and not self.relay:
            raise ConfigError(f"gateway.faults: found {self.faults!r}, expected it with relay = true only")
        for name in ("deny_in", "deny_out"):
            for glob in getattr(self, name):
                if not _is_type_glob(glob):
                    raise ConfigError(f"gateway.{name}: found {glob!r}, expected a type or a glob: COMMAND, GET_*")
        for index, peer in enumerate(self.peers):
            _check_choices(f"peers[{index}]", peer, optional=False)
        for index, frames in enumerate(self.tf_out):
            _check_choices(f"tf_out[{index}]", frames, optional=True)
            frames.request(f"tf_out[{index}]")
        for name, rows in (("to_igtl", self.to_igtl), ("to_ros", self.to_ros)):
            for index, row in enumerate(rows):
                _check_choices(f"{name}[{index}]", row, optional=True)
                if row.qos and not 1 <= row.qos.depth <= MAX_DEPTH:
                    raise ConfigError(f"{name}[{index}].qos.depth: found {row.qos.depth}, expected 1 to {MAX_DEPTH:,}")
        if self.max_streams < 1:
            raise ConfigError(f"gateway.max_streams: found {self.max_streams}, expected 1 or more")
        ages = [(f"to_igtl[{index}]", sent.max_age_s) for index, sent in enumerate(self.to_igtl)]
        ages += [(f"to_ros[{index}]", shown.max_age_s) for index, shown in enumerate(self.to_ros)]
        ages += [(f"tf_out[{index}]", frames.max_age_s) for index, frames in enumerate(self.tf_out)]
        for place, age_s in ages:
            if not 0.0 <= age_s <= MAX_AGE_S:
                raise ConfigError(f"{place}.max_age_s: found {age_s:g}, expected 0 (any age) to {MAX_AGE_S:g}")
        for index, sent in enumerate(self.to_igtl):
            if not _is_topic(sent.topic):
                raise ConfigError(f"to_igtl[{index}].topic: found {sent.topic!r}, expected one such as /camera/image")
            if sent.type not in _SENT_TYPES and sent.type != "":
                raise ConfigError(
                    f"to_igtl[{index}].type: found {sent.type!r}, expected one of {', '.join(_SENT_TYPES)}"
                )
        for index, row in enumerate(self.to_ros):
            if not (_is_topic(row.topic) and row.topic.startswith("/")):
                raise ConfigError(f"to_ros[{index}].topic: found {row.topic!r}, expected one such as /in/{{device}}")
            if not _is_template(row.topic):
                raise ConfigError(
                    f"to_ros[{index}].topic: found {row.topic!r}, "
                    "expected only {device}, {kind} and {type} in braces"
                )

    def row_to_igtl(self, topic: str) -> ToIgtlRow | None:
        """The row for a ROS topic: the first that matches, or None where the topic is not bridged."""
        return next((row for row in (*self.to_igtl, _DEFAULT_TO_IGTL) if matches(row.topic, topic)), None)

    def row_to_ros(self, igtl_type: str, device: str) -> ToRosRow:
        """The row for an OpenIGTLink stream: the first that matches (the default matches all)."""
        for row in self.to_ros:
            if matches(row.device, device) and matches(row.type, igtl_type):
                return row
        return _DEFAULT_TO_ROS

    def lengths(self, row: _Row) -> LengthUnits:
        """Units of a row."""
        return LengthUnits(row.ros_unit or self.ros_unit, row.igtl_unit or self.igtl_unit)

    def pick_stamp(self, row: _Row, source_ns: int, received_ns: int) -> int:
        """The stamp of an outgoing message: never 0."""
        # a negative stamp (before 1970) has no tick word
        return source_ns if source_ns > 0 and self.stamp_of(row) == SOURCE else received_ns

    def stamp_of(self, row: _Row) -> str:
        """Return the stamp policy of a row: ``SOURCE`` or ``RECEIVE``."""
        policy = row.stamp or self.stamp
        return _STAMP_ALIASES.get(policy, policy)

    def watched(self, unless_set: bool | None = True) -> Config:
        """The configuration with ``watch`` settled, where it leaves that open: on in a live session."""
        return dataclasses.replace(self, watch=unless_set) if self.watch is None else self

    def to_dict(self) -> dict[str, Any]:
        """As JSON values: what is stored in a recording."""
        return dataclasses.asdict(self)

    def to_toml(self) -> str:
        """As the text of a file: what differs from the default settings."""
        own, default = dataclasses.asdict(self), dataclasses.asdict(Config())
        lines = ["[gateway]", *_toml_lines({n: v for n, v in own.items() if n not in _TABLES and v != default[n]})]
        for name in sorted(_TABLES):
            for row in getattr(self, name):
                given, usual = dataclasses.asdict(row), dataclasses.asdict(type(row)())
                lines += ["", f"[[{name}]]", *_toml_lines({n: v for n, v in given.items() if v != usual[n]})]
        return "\n".join(lines) + "\n"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """From the values of ``to_dict``.  Raises ConfigError with the path of the wrong setting."""
        settings = dict(values)
        to_igtl = _rows("to_igtl", settings.pop("to_igtl", ()), ToIgtlRow)
        to_ros = _rows("to_ros", settings.pop("to_ros", ()), ToRosRow)
        tf_out = _rows("tf_out", settings.pop("tf_out", ()), TfOutRow)
        peers = _rows("peers", settings.pop("peers", ()), PeerRow)
        rows = {"to_igtl": to_igtl, "to_ros": to_ros, "tf_out": tf_out, "peers": peers}
        return from_values("gateway", cls, settings | rows)

    @classmethod
    def from_toml(cls, path: Path) -> Config:
        """From a TOML file.  Raises ConfigError with file and setting."""
        document = read_toml(path)
        document.pop(EDGE_TABLE, None)
        gateway = document.pop("gateway", {})
        if unknown := set(document) - _TABLES:
            expected = ", ".join(f"[[{name}]]" for name in sorted(_TABLES))
            raise ConfigError(f"{path}: found [{sorted(unknown)[0]}], expected [gateway], [{EDGE_TABLE}], {expected}")
        if not isinstance(gateway, dict):
            raise ConfigError(f"{path}: found gateway = {gateway!r}, expected a table [gateway]")
        try:
            return cls.from_dict(gateway | document)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a configuration file.  Raises ConfigError."""
    try:
        return parse_toml(read_bytes(path), str(path))
    except UnsupportedRecording as error:
        raise ConfigError(f"{path}: cannot be read: {str(error).removeprefix(f'{path}: ')}") from None
    except DamagedRecording as error:
        raise ConfigError(str(error)) from None


#: The table of a configuration file that says who may connect, where, and at what cost: not what is said.
EDGE_TABLE = "igtl"
_TABLES = frozenset({"to_igtl", "to_ros", "tf_out", "peers"})


def _toml_lines(settings: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_toml(name, value)}" for name, value in settings.items()]


def _toml(name: str, value: Any) -> str:
    if name == "metadata":
        value = dict(value)
    if isinstance(value, Mapping):
        pairs = (f"{json.dumps(key, ensure_ascii=False)} = {_toml(key, item)}" for key, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    # texts, numbers, truth and lists of texts are written as in JSON
    return json.dumps(value, ensure_ascii=False)


_DEFAULT_TO_IGTL = ToIgtlRow()
_DEFAULT_TO_ROS = ToRosRow()


def device_of_topic(topic: str, kind: str = "") -> str:
    """Device name of a topic that names none: its path behind ``/igtl/out/``, without the row's kind.

    ``/igtl/out/Tool`` and ``/igtl/out/Tool/transform`` give ``Tool``; ``/camera/image`` gives ``camera_image``.
    """
    path = topic.removeprefix(OUT_PREFIX).strip("/")
    head, _, tail = path.rpartition("/")
    return (head if head and tail == kind else path).replace("/", "_")


#: What ROS messages may become.
_SENT_TYPES = tuple(sorted({row.igtl_type for row in TO_IGTL}))

_CHOICES = {
    "ros_unit": tuple(UNITS),
    "igtl_unit": tuple(UNITS),
    "stamp": (*STAMP_POLICIES, *_STAMP_ALIASES),
    "profile": PROFILE_NAMES,
}

T = TypeVar("T")


def _is_topic(topic: str) -> bool:
    """Whether ``topic`` (a name or a pattern) can be one of the ROS graph, whose full names begin with a slash."""
    return topic.startswith(("/", "**")) and not any(character.isspace() for character in topic)


def _is_type_glob(glob: str) -> bool:
    """Whether ``glob`` can match the type of a message: twelve bytes, no blanks."""
    return glob.isascii() and glob.isprintable() and bool(glob) and not set(glob) & set(" /,")


def _is_template(topic: str) -> bool:
    """Whether ``topic`` has nothing but plain names in its braces; no attributes, indices or formats."""
    try:
        parts = list(Formatter().parse(topic))
    except ValueError:
        return False
    return all(
        name is None or (name in ("device", "kind", "type") and not layout and not conversion)
        for _, name, layout, conversion in parts
    )


def _check_choices(place: str, settings: object, *, optional: bool) -> None:
    for name, choices in _CHOICES.items():
        value = getattr(settings, name, None)
        if value is None:
            continue
        if value not in choices and not (optional and value == ""):
            raise ConfigError(f"{place}.{name}: found {value!r}, expected one of {', '.join(choices)}")


def _rows(place: str, rows: Any, kind: type[T]) -> tuple[T, ...]:
    if not isinstance(rows, list | tuple):
        raise ConfigError(f"{place}: found {rows!r}, expected rows [[{place}]]")
    made = []
    for index, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise ConfigError(f"{place}[{index}]: found {row!r}, expected a table")
        settings = dict(row)
        if isinstance(settings.get("metadata"), Mapping):
            settings["metadata"] = tuple(settings["metadata"].items())
        if isinstance(settings.get("qos"), Mapping):
            settings["qos"] = from_values(f"{place}[{index}].qos", Qos, settings["qos"])
        made.append(from_values(f"{place}[{index}]", kind, settings))
    return tuple(made)


def from_values(place: str, kind: type[T], settings: Mapping[str, Any]) -> T:
    """An instance of a dataclass from plain values.  Raises ConfigError for unknown names and wrong types."""
    fields = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    made: dict[str, Any] = {}
    for name, given in settings.items():
        if name not in fields:
            raise ConfigError(f"{place}.{name}: unknown setting, expected one of {', '.join(fields)}")
        made[name] = _value(f"{place}.{name}", name, type(fields[name].default), given)
    return kind(**made)


def _value(place: str, name: str, wanted: type, given: Any) -> Any:
    """One setting, of the type of its default."""
    if wanted is float and type(given) is int and abs(given) < 1 << 63:
        return float(given)
    if wanted in _TYPE_NAMES and type(given) is not wanted:
        raise ConfigError(f"{place}: found {given!r}, expected a {_TYPE_NAMES[wanted]}")
    if name == "watch" and not (given is None or type(given) is bool):
        raise ConfigError(f"{place}: found {given!r}, expected true or false")
    if name in _TEXT_LISTS:
        if not (isinstance(given, list | tuple) and all(isinstance(item, str) for item in given)):
            raise ConfigError(f'{place}: found {given!r}, expected texts such as ["a", "b"]')
        return tuple(given)
    if name == "metadata":
        return _pairs(place, given)
    if name == "qos" and not (given is None or isinstance(given, Qos)):
        raise ConfigError(f"{place}: found {given!r}, expected a table such as {{ depth = 10 }}")
    return given


def _pairs(place: str, value: Any) -> tuple[tuple[str, str], ...]:
    pairs = tuple(tuple(pair) if isinstance(pair, list | tuple) else (pair,) for pair in value or ())
    if not all(len(pair) == 2 and all(isinstance(text, str) for text in pair) for pair in pairs):
        raise ConfigError(f'{place}: found {value!r}, expected a table of texts such as {{ operator = "A. B." }}')
    return pairs


_TEXT_LISTS = frozenset({"allow", "connect", "deny_in", "deny_out", "frames", "kinds", "listen"})
_TYPE_NAMES: dict[type, str] = {
    str: "text in quotes",
    bool: "true or false",
    int: "whole number",
    float: "number",
}
