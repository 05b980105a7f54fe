"""Configuration: frozen values from a TOML file or from a recording, checked when they are created.

The configuration contains every setting that influences the outputs of the gateway, and is stored in the recording:
replay and verification use the settings of the recorded session.

::

    [gateway]
    base_frame = "igtl"            # frame of messages that do not name a frame
    ros_unit = "m"                 # m, dm, cm, mm, um
    igtl_unit = "mm"
    stamp = "source"               # source: the sender's stamp, if set; receive: the gateway time of receipt
    check_crc = true
    profile = "auto"               # profile of all peers: slicer, plus …; auto: detected from their messages
                                   # crtk:/PSM*: auto, and the CRTK topics of these arms
    publish_tf = true              # publish poses on /tf, too
    command_timeout_s = 5.0        # time after which a COMMAND without a reply has failed
    relay = false                  # true: forward bytes unchanged between clients and one server, without ROS
    faults = ""                    # fault injection of a relay: "delay=50ms,in:loss=1%", see docs/how-to/faults.md
    fault_seed = 0                 # seed of the fault injection
    deny_in = []                   # types that are refused from peers, such as ["COMMAND", "TRANSFORM"] or ["*"]
    deny_out = []                  # types that are not sent to peers
    allow_in = []                  # CRTK devices that peers may send to ROS, such as ["PSM1/servo_cp", "ECM/move_*"]
    allow_out = []                 # CRTK commands of ROS that are sent to peers
    mark_from = []                 # devices whose STRING and COMMAND "Mark" make marks, see docs/how-to/marks.md
    max_age_s = 0.0                # default of the rows: messages that are older on arrival are withheld; 0: no limit
    kinds = []                     # default of the rows of [[to_ros]], see there
    watch = true                   # report jumps of units, decreasing stamps …; by default in live sessions only
    cautious = true                # send peers that are not recognised only what every program can skip; by default
                                   # in live sessions only
    keep_mib = 48                  # MiB of the last images of all devices but the newest, and of the last messages of
                                   # topics; by default in live sessions only
    latched_mib = 1536             # MiB of the latched messages of all topics; by default in live sessions only
    max_behind_s = 0.2             # default of the rows of [[crtk]]: how far set points may be from the measured state,
                                   # as a time at the speed limits; 0: any distance; by default in live sessions only

    [[to_igtl]]                    # ROS topic → OpenIGTLink; the first matching row applies
    topic = "/camera/image_raw"    # * matches within one level, ** across levels
    device = "Camera"              # default: from the topic
    type = "IMAGE"                 # default: by the conversion table
    max_age_s = 0.5                # messages that are older on arrival are withheld; 0: no limit

    [[to_ros]]                     # OpenIGTLink → ROS
    device = "Probe*"
    topic = "/probe/{device}/{kind}"
    frame_id = "tracker"
    max_age_s = 0.5                # as above
    kinds = ["+slices"]            # +: messages on request besides the default ones; without +: only these

    [[tf_out]]                     # frames of /tf and /tf_static → OpenIGTLink, chains composed
    frames = ["tool"]
    base = "base_link"
    device = "Tool"                # default: toolTobase_link
    max_age_s = 0.5                # as above; the oldest transform of a chain applies

    [[peers]]                      # profiles of single peers
    at = "127.0.0.1:18945"         # address of the peer, or the one that it connects to
    profile = "plus"

    [[crtk]]                       # arms with CRTK topics, and the limits of commands to them, see docs/how-to/crtk.md
    arms = "/PSM*"
    workspace = [-0.1, -0.1, -0.2, 0.1, 0.1, 0.0]  # m; in frame_id, by default that of measured_cp
    max_speed = 0.1                # m/s

    [igtl]                         # the OpenIGTLink side of a bridge; ``settings`` has all names; not recorded
    listen = ["127.0.0.1:18944"]

    [host]                         # scheduling of a bridge on this machine; not recorded
    realtime_priority = 20

    [record]                       # what is done with closed recordings; not recorded
    retention = "30 d, 200 GB"

Rows may override ros_unit, igtl_unit, stamp and, as ``qos = { depth = 10, reliable = true, latched = false }``,
the quality of service.  By default, the messages of a device are published on ``/igtl/in/<device>/<kind>``, and ROS
messages on topics below ``/igtl/out/`` are sent to the peers.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from string import Formatter
from types import MappingProxyType
from typing import Any, TypeVar

from igtl_gateway.base.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.base.globs import MAX_LENGTH, matches
from igtl_gateway.base.near import did_you_mean, near_names, one_of
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.untrusted.files import read_bytes
from igtl_gateway.base.untrusted.text import parse_toml
from igtl_gateway.config.faults import RelayFaults
from igtl_gateway.config.setting import GATEWAY, HOST, IGTL, RECORD, TYPE_NAMES
from igtl_gateway.config.setting import unknown as unknown_setting
from igtl_gateway.config.settings import (
    DEFAULT_KEEP_MIB,
    DEFAULT_LATCHED_MIB,
    DEFAULT_MAX_BEHIND_S,
    PROFILE_NAMES,
    RECEIVE,
    SOURCE,
    STAMP_POLICIES,
    check_values,
    of_table,
    table_with,
)
from igtl_gateway.convert import crtk
from igtl_gateway.convert.arms import ArmsRow, arms_of_profile, arms_row
from igtl_gateway.convert.choices import AUTO
from igtl_gateway.convert.frames import TfRequest
from igtl_gateway.convert.table import TO_IGTL
from igtl_gateway.convert.units import UNITS, LengthUnits
from igtl_gateway.wire.header import READING

#: Settings that older recordings do not have, and their default in a live session.  They are None in these recordings.
LIVE: Mapping[str, bool | int | float] = {
    "watch": True,
    "cautious": True,
    "keep_mib": DEFAULT_KEEP_MIB,
    "latched_mib": DEFAULT_LATCHED_MIB,
    "max_behind_s": DEFAULT_MAX_BEHIND_S,
}
#: The rules by which devices, tools and topics get names; older recordings do not state them, which is 0.
#: 1: each frame on /tf has one sender, what shares a name is noted, full names and frames of known programs are read;
#: tracking data of frames of the tf tree and of single poses has the poses of its stamp.
#: 2: names of PLUS are divided as it divides them, and whole where it has cut them; tracking data whose tools have one
#: parent are in its frame.
NAMING = 2
#: The rules by which messages are fitted to what a peer reads; older recordings do not state them, which is 0.
#: 1: 3D Slicer gets no type that it does not read, but what shows the same, and CRTK arms in millimetres; until a peer
#: has sent its first message, it gets only what every known program reads.
#: 2: a peer without metadata (header version 1) finds the failure of its command in the text of the reply.
FITTING = 2
#: Former names of the policies, in the configurations of old recordings.
_STAMP_ALIASES = {"now": RECEIVE}
#: Of a field that a session records, and a user cannot set.
_RECORDED: Mapping[str, bool] = MappingProxyType({"recorded": True})
#: Commands to robots: of a stream only the newest counts, so that nothing older is sent again to a reader that lags.
COMMAND_QOS, SET_POINT_QOS = Qos(10), Qos(1)
OUT_PREFIX = "/igtl/out/"
IN_TOPIC = "/igtl/in/{device}/{kind}"

#: Maximum number of streams of one session in each direction; it protects the ROS graph from arbitrary names.
DEFAULT_MAX_STREAMS = 512

#: Maximum depth of the queue of a ROS stream; it bounds the memory for a slow subscriber.
MAX_DEPTH = 100_000


@dataclass(frozen=True, slots=True)
class _Row:
    """Settings of the rows of both directions; "" and None: the setting of ``[gateway]`` applies."""

    ros_unit: str = ""
    igtl_unit: str = ""
    stamp: str = ""
    qos: Qos | None = None


@dataclass(frozen=True, slots=True)
class ToIgtlRow(_Row):
    """Route of ROS topics (a glob) to OpenIGTLink; ``metadata`` is added for peers with header version 2."""

    topic: str = OUT_PREFIX + "**"
    device: str = ""
    type: str = ""
    metadata: tuple[tuple[str, str], ...] = ()
    max_age_s: float | None = None


@dataclass(frozen=True, slots=True)
class ToRosRow(_Row):
    """Route of OpenIGTLink devices (a glob) to ROS; ``kinds`` selects the ROS messages to publish."""

    device: str = "**"
    type: str = "**"
    topic: str = IN_TOPIC
    frame_id: str = ""
    child_frame_id: str = ""
    kinds: tuple[str, ...] = ()
    max_age_s: float | None = None


@dataclass(frozen=True, slots=True)
class TfOutRow(_Row):
    """Route of frames of the tf tree to OpenIGTLink, as poses in ``base``."""

    frames: tuple[str, ...] = ()
    base: str = ""
    device: str = ""
    type: str = ""
    max_age_s: float | None = None

    def request(self, place: str = "tf_out") -> TfRequest:
        """Return the request for the tf tree.  Raises ConfigError with ``place``."""
        try:
            request = TfRequest.parse(f"{','.join(self.frames)}:{self.base}")
            return dataclasses.replace(request, device=self.device or request.device, type=self.type or request.type)
        except ConfigError as error:
            raise ConfigError(f"{place}: {error}") from None


@dataclass(frozen=True, slots=True)
class PeerRow:
    """Profile of the peers at an address (a glob)."""

    at: str = "**"
    profile: str = AUTO


@dataclass(frozen=True, slots=True)
class Config:
    """The configuration of a session; see the module for the meaning of each setting.

    ``watch`` adds notes.  None, as in recordings that are older than this setting, means no such notes.  Live sessions
    set it; see ``watched``.  ``cautious``, ``keep_mib``, ``latched_mib`` and ``max_behind_s`` are None in older
    recordings, too: there, peers are treated as they were then, nothing is forgotten, and arms need not follow.

    ``naming`` is the version of the rules by which streams get their topics and frames: ``NAMING``, or 0, as in
    recordings that are older than it, so that they give the same names.  ``fitting`` is the version of the rules by
    which messages are fitted to what a peer reads, ``reading`` of those by which messages that deviate from the
    protocol are read (``wire.header.READING``), likewise.  They are not settings of the user.
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
    allow_in: tuple[str, ...] = ()
    allow_out: tuple[str, ...] = ()
    mark_from: tuple[str, ...] = ()
    max_age_s: float = 0.0
    kinds: tuple[str, ...] = ()
    watch: bool | None = None
    cautious: bool | None = None
    keep_mib: int | None = None
    latched_mib: int | None = None
    max_behind_s: float | None = None
    naming: int = dataclasses.field(default=NAMING, metadata=_RECORDED)
    fitting: int = dataclasses.field(default=FITTING, metadata=_RECORDED)
    reading: int = dataclasses.field(default=READING, metadata=_RECORDED)
    to_igtl: tuple[ToIgtlRow, ...] = ()
    to_ros: tuple[ToRosRow, ...] = ()
    tf_out: tuple[TfOutRow, ...] = ()
    peers: tuple[PeerRow, ...] = ()
    crtk: tuple[ArmsRow, ...] = ()

    def __post_init__(self) -> None:
        values = {name: getattr(self, name) for name in of_table(GATEWAY)}
        values["stamp"] = _STAMP_ALIASES.get(self.stamp, self.stamp)
        for name in LIVE:
            if values[name] is None:
                del values[name]
        check_values(GATEWAY, GATEWAY, values)
        for place, glob in self._globs():
            if len(glob) > MAX_LENGTH:
                found = f"a glob of {count_text(len(glob), 'character')}, {glob[:40]}…"
                raise ConfigError(f"{place}: found {found}, expected at most {MAX_LENGTH:,}")
        if RelayFaults.parse(self.faults, "gateway.faults") and not self.relay:
            raise ConfigError(f"gateway.faults: found {self.faults!r}, expected relay = true with it")
        for index, peer in enumerate(self.peers):
            _check_choices(f"peers[{index}]", peer, optional=False)
        for index, arms in enumerate(self.crtk):
            arms.check(f"crtk[{index}]")
        for index, frames in enumerate(self.tf_out):
            _check_choices(f"tf_out[{index}]", frames, optional=True)
            frames.request(f"tf_out[{index}]")
        for name, rows in (("to_igtl", self.to_igtl), ("to_ros", self.to_ros)):
            for index, row in enumerate(rows):
                _check_choices(f"{name}[{index}]", row, optional=True)
                if row.qos and not 1 <= row.qos.depth <= MAX_DEPTH:
                    raise ConfigError(f"{name}[{index}].qos.depth: found {row.qos.depth}, expected 1 to {MAX_DEPTH:,}")
        ages = [(f"to_igtl[{index}]", sent.max_age_s) for index, sent in enumerate(self.to_igtl)]
        ages += [(f"to_ros[{index}]", shown.max_age_s) for index, shown in enumerate(self.to_ros)]
        ages += [(f"tf_out[{index}]", frames.max_age_s) for index, frames in enumerate(self.tf_out)]
        for place, age_s in ages:
            if age_s is not None:
                check_values(place, GATEWAY, {"max_age_s": age_s})
        for index, sent in enumerate(self.to_igtl):
            if not _is_topic(sent.topic):
                raise ConfigError(
                    f"to_igtl[{index}].topic: found {sent.topic!r}, expected a topic such as /camera/image"
                )
            if sent.type not in _SENT_TYPES and sent.type != "":
                raise ConfigError(
                    f"to_igtl[{index}].type: found {sent.type!r}, expected {one_of(sent.type, _SENT_TYPES)}"
                )
        for index, row in enumerate(self.to_ros):
            if not (_is_topic(row.topic) and row.topic.startswith("/")):
                raise ConfigError(
                    f"to_ros[{index}].topic: found {row.topic!r}, expected an absolute topic such as /in/{{device}}"
                )
            if not _is_template(row.topic):
                raise ConfigError(
                    f"to_ros[{index}].topic: found {row.topic!r}, "
                    "expected only {device}, {kind} and {type} in braces"
                )

    def _globs(self) -> Iterator[tuple[str, str]]:
        """Yield the place of each glob, and the glob."""
        for table, names in _GLOBS.items():
            for index, row in enumerate(getattr(self, table)):
                yield from ((f"{table}[{index}].{name}", getattr(row, name)) for name in names)
        for name in _GLOB_LISTS:
            yield from ((name, glob) for glob in getattr(self, name))

    def row_to_igtl(self, topic: str) -> ToIgtlRow | None:
        """Return the first row that matches a ROS topic; None if the topic is not bridged."""
        if row := next((row for row in self.to_igtl if matches(row.topic, topic)), None):
            return row
        if self.all_arms and (row := self._crtk_row_to_igtl(topic)):
            return row
        return _DEFAULT_TO_IGTL if matches(_DEFAULT_TO_IGTL.topic, topic) else None

    def _crtk_row_to_igtl(self, topic: str) -> ToIgtlRow | None:
        """Return the row of a state of an arm, or of a command that ``allow_out`` has; None for other topics.

        A device goes in one direction: what peers may send is not sent back to them.
        """
        device = topic.removeprefix("/")
        arms, name = arms_row(self.all_arms, device), crtk.row_of(device)
        if arms is None or name is None or self.allows_in(device):
            return None
        if name.motion and not any(matches(glob, device) for glob in self.allow_out):
            return None
        return ToIgtlRow(topic=topic, device=device, type=name.igtl_type, ros_unit="m", igtl_unit=arms.igtl_unit)

    def row_to_ros(self, igtl_type: str, device: str) -> ToRosRow:
        """Return the first row that matches an OpenIGTLink stream; the default row matches all."""
        arms = arms_row(self.all_arms, device) if self.all_arms else None
        if arms and (name := crtk.row_of(device)) and self.allows_in(device):
            return ToRosRow(
                device=device,
                topic=f"/{device}",
                kinds=(name.kind,),
                ros_unit="m",
                igtl_unit=arms.igtl_unit,
                frame_id=arms.frame_id,
                max_age_s=0.0 if name.motion else None,  # the age of a command has a check of its own
                qos=SET_POINT_QOS if name.streamed else COMMAND_QOS if name.motion else None,
            )
        for row in self.to_ros:
            if matches(row.device, device) and matches(row.type, igtl_type):
                return row
        return ToRosRow(igtl_unit=arms.igtl_unit) if arms else _DEFAULT_TO_ROS

    @property
    def all_arms(self) -> tuple[ArmsRow, ...]:
        """The arms with CRTK topics: those of ``crtk``, then those of the profile."""
        glob = arms_of_profile(self.profile)
        return self.crtk if glob is None else (*self.crtk, ArmsRow(glob))

    @property
    def peer_profile(self) -> str:
        """The profile of peers without a row in ``peers``."""
        return self.profile if arms_of_profile(self.profile) is None else AUTO

    def allows_in(self, device: str) -> bool:
        """Return whether peers may send a CRTK device, such as ``PSM1/servo_cp``, to its topic."""
        return any(matches(glob, device) for glob in self.allow_in)

    def lengths(self, row: _Row) -> LengthUnits:
        """Return the length units of a row."""
        return LengthUnits(row.ros_unit or self.ros_unit, row.igtl_unit or self.igtl_unit)

    def pick_stamp(self, row: _Row, source_ns: int, received_ns: int) -> int:
        """Return the stamp of a converted message, UTC ns; never 0 if ``received_ns`` is not."""
        # a negative stamp (before 1970) has no tick word
        return source_ns if source_ns > 0 and self.stamp_of(row) == SOURCE else received_ns

    def stamp_of(self, row: _Row) -> str:
        """Return the stamp policy of a row: ``SOURCE`` or ``RECEIVE``."""
        policy = row.stamp or self.stamp
        return _STAMP_ALIASES.get(policy, policy)

    def max_age_of(self, row: ToIgtlRow | ToRosRow | TfOutRow) -> float:
        """Return the maximum age of the messages of a row, s; 0: no limit."""
        return self.max_age_s if row.max_age_s is None else row.max_age_s

    def kinds_of(self, row: ToRosRow) -> tuple[str, ...]:
        """Return the selection of ROS messages of a row; empty: the default ones."""
        return row.kinds or self.kinds

    def as_live_as(self, recorded: Config) -> Config:
        """Return the configuration with the settings in ``LIVE`` of a recording, where it does not set them."""
        as_live = self._with_live({name: getattr(recorded, name) for name in LIVE})
        return dataclasses.replace(as_live, naming=recorded.naming, fitting=recorded.fitting, reading=recorded.reading)

    def watched(self) -> Config:
        """Return the configuration of a live session: the settings in ``LIVE`` have their defaults if they are None."""
        return self._with_live(LIVE)

    def _with_live(self, values: Mapping[str, Any]) -> Config:
        return dataclasses.replace(
            self, **{name: value for name, value in values.items() if getattr(self, name) is None}
        )

    @property
    def knows_peers(self) -> bool:
        """Whether the session recognises peers by all their signs, and holds back what they cannot read.

        False in recordings that are older than ``cautious``, so that they give the same outputs.
        """
        return self.cautious is not None

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON values, as stored in a recording.

        Settings that older programs do not know are left out if they are not set: these can then read the recording.
        """
        values = dataclasses.asdict(self)
        for name in (
            "max_age_s",
            "kinds",
            "allow_in",
            "allow_out",
            "mark_from",
            "naming",
            "fitting",
            "reading",
            "crtk",
        ):
            if not values[name]:
                del values[name]
        for name in ("cautious", "keep_mib", "latched_mib", "max_behind_s"):
            if values[name] is None:
                del values[name]
        for row in values.get("crtk", ()):
            if row["max_behind_s"] is None:
                del row["max_behind_s"]
        for table in ("to_igtl", "to_ros", "tf_out"):
            for row in values[table]:
                if row["max_age_s"] is None:
                    del row["max_age_s"]
        return values

    def to_toml(self) -> str:
        """Return the text of a TOML file with all settings that differ from the defaults."""
        own, default = dataclasses.asdict(self), dataclasses.asdict(Config())
        lines = ["[gateway]", *_toml_lines({n: v for n, v in own.items() if n not in _TABLES and v != default[n]})]
        for name in sorted(_TABLES):
            for row in getattr(self, name):
                values, defaults = dataclasses.asdict(row), dataclasses.asdict(type(row)())
                lines += ["", f"[[{name}]]", *_toml_lines({n: v for n, v in values.items() if v != defaults[n]})]
        return "\n".join(lines) + "\n"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """Return the configuration for the values of ``to_dict``, of a recording: what they do not have is as it was.

        Raises ConfigError with the path of the setting.
        """
        settings = {"naming": 0, "fitting": 0, "reading": 0, **values}
        to_igtl = _rows("to_igtl", settings.pop("to_igtl", ()), ToIgtlRow)
        to_ros = _rows("to_ros", settings.pop("to_ros", ()), ToRosRow)
        tf_out = _rows("tf_out", settings.pop("tf_out", ()), TfOutRow)
        peers = _rows("peers", settings.pop("peers", ()), PeerRow)
        arms = _rows("crtk", settings.pop("crtk", ()), ArmsRow)
        rows = {"to_igtl": to_igtl, "to_ros": to_ros, "tf_out": tf_out, "peers": peers, "crtk": arms}
        return from_values("gateway", cls, settings | rows)

    @classmethod
    def of_values(cls, values: Mapping[str, Any]) -> Config:
        """Return the configuration of a new session.  Raises ConfigError as ``from_dict``."""
        return cls.from_dict({**values, "naming": NAMING, "fitting": FITTING, "reading": READING})

    @classmethod
    def from_toml(cls, path: Path) -> Config:
        """Read a TOML file.  Raises ConfigError with file and setting."""
        document = read_toml(path)
        for table in (IGTL, HOST, RECORD, "trigger"):
            document.pop(table, None)
        gateway = document.pop("gateway", {})
        if unknown := sorted(set(document) - _TABLES):
            if (home := table_with(unknown[0])) and not isinstance(document[unknown[0]], dict):
                raise ConfigError(f"{path}: {unknown[0]}: found above all tables, expected in [{home}]")
            expected = ", ".join(f"[[{name}]]" for name in sorted(_TABLES | {"trigger"}))
            tables = f"[gateway], [{HOST}], [{IGTL}], [{RECORD}]"
            near = did_you_mean(near_names(unknown[0], {HOST, IGTL, RECORD, "gateway", "trigger", *_TABLES}))
            raise ConfigError(
                f"{path}: found [{unknown[0]}], expected {tables}, {expected}" + (f"; {near}" if near else "")
            )
        if not isinstance(gateway, dict):
            raise ConfigError(f"{path}: found gateway = {gateway!r}, expected a table [gateway]")
        try:
            return cls.of_values(gateway | document)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return the tables of a configuration file.  Raises ConfigError."""
    try:
        return parse_toml(read_bytes(path), str(path))
    except UnsupportedRecording as error:
        raise ConfigError(f"{path}: cannot be read: {str(error).removeprefix(f'{path}: ')}") from None
    except DamagedRecording as error:
        raise ConfigError(str(error)) from None


_TABLES = frozenset({"to_igtl", "to_ros", "tf_out", "peers", "crtk"})


def _toml_lines(settings: Mapping[str, Any]) -> list[str]:
    return [f"{name} = {_toml(name, value)}" for name, value in settings.items()]


def _toml(name: str, value: Any) -> str:
    if name == "metadata":
        value = dict(value)
    if isinstance(value, Mapping):
        pairs = (f"{json.dumps(key, ensure_ascii=False)} = {_toml(key, item)}" for key, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    # strings, numbers, booleans and lists of strings are written as in JSON
    return json.dumps(value, ensure_ascii=False)


_DEFAULT_TO_IGTL = ToIgtlRow()
_DEFAULT_TO_ROS = ToRosRow()


def device_of_topic(topic: str, kind: str = "") -> str:
    """Return the default device name of a topic: its path after ``/igtl/out/``, without the row's kind.

    ``Tool`` for ``/igtl/out/Tool`` and ``/igtl/out/Tool/transform``; ``camera_image`` for ``/camera/image``.
    """
    path = topic.removeprefix(OUT_PREFIX).strip("/")
    head, _, tail = path.rpartition("/")
    return (head if head and tail == kind else path).replace("/", "_")


#: OpenIGTLink types that ROS messages can be converted to.
_SENT_TYPES = tuple(sorted({row.igtl_type for row in TO_IGTL}))

_CHOICES = {
    "ros_unit": tuple(UNITS),
    "igtl_unit": tuple(UNITS),
    "stamp": (*STAMP_POLICIES, *_STAMP_ALIASES),
    "profile": PROFILE_NAMES,
}

T = TypeVar("T")


def _is_topic(topic: str) -> bool:
    """Return whether ``topic`` (a name or a glob) can match a ROS topic: full names begin with a slash."""
    return topic.startswith(("/", "**")) and not any(character.isspace() for character in topic)


def _is_template(topic: str) -> bool:
    """Return whether the braces of ``topic`` contain only known names, without attributes, indices and formats."""
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
            raise ConfigError(f"{place}.{name}: found {value!r}, expected {one_of(str(value), choices)}")


def _rows(place: str, rows: Any, kind: type[T]) -> tuple[T, ...]:
    if not isinstance(rows, list | tuple):
        raise ConfigError(f"{place}: found {rows!r}, expected tables [[{place}]]")
    result = []
    for index, row in enumerate(rows):
        if not isinstance(row, Mapping):
            raise ConfigError(f"{place}[{index}]: found {row!r}, expected a table")
        settings = dict(row)
        if isinstance(settings.get("metadata"), Mapping):
            settings["metadata"] = tuple(settings["metadata"].items())
        if isinstance(settings.get("qos"), Mapping):
            settings["qos"] = from_values(f"{place}[{index}].qos", Qos, settings["qos"])
        result.append(from_values(f"{place}[{index}]", kind, settings))
    return tuple(result)


def from_values(place: str, kind: type[T], settings: Mapping[str, Any]) -> T:
    """Return an instance of a dataclass for plain values.  Raises ConfigError for unknown names and wrong types."""
    fields = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for name, value in settings.items():
        if name not in fields:
            if place == GATEWAY and (home := table_with(name)) not in ("", GATEWAY):
                raise ConfigError(f"{place}.{name}: found in [{place}], expected in [{home}]")
            known = (each for each, item in fields.items() if not item.metadata.get("recorded"))
            raise ConfigError(f"{place}.{name}: {unknown_setting(name, known)}")
        _check_text(f"{place}.{name}", value)
        arguments[name] = _checked(f"{place}.{name}", name, type(fields[name].default), value)
    return kind(**arguments)


def _checked(place: str, name: str, kind: type, value: Any) -> Any:
    """Return the value of a setting as the type of its default.  Raises ConfigError."""
    if name in ("max_age_s", "max_behind_s") and value is not None:
        kind = float
    if kind is float and type(value) is int and abs(value) < 1 << 63:
        return float(value)
    if kind is not tuple and kind in TYPE_NAMES and type(value) is not kind:
        raise ConfigError(f"{place}: found {value!r}, expected {TYPE_NAMES[kind]}")
    if name in LIVE and not (value is None or type(value) is type(LIVE[name])):
        raise ConfigError(f"{place}: found {value!r}, expected {TYPE_NAMES[type(LIVE[name])]}")
    if name in _TEXT_LISTS:
        if not (isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)):
            raise ConfigError(f'{place}: found {value!r}, expected strings such as ["a", "b"]')
        return tuple(value)
    if name in _NUMBER_LISTS:
        if not (isinstance(value, list | tuple) and all(map(_is_number, value))):
            raise ConfigError(f"{place}: found {value!r}, expected numbers such as [0.1, 0.2]")
        return tuple(map(float, value))
    if name == "metadata":
        return _pairs(place, value)
    if name == "qos" and not (value is None or isinstance(value, Qos)):
        raise ConfigError(f"{place}: found {value!r}, expected a table such as {{ depth = 10 }}")
    return value


def _is_number(value: object) -> bool:
    return type(value) is float or (type(value) is int and abs(value) < 1 << 63)


def _check_text(place: str, value: object) -> None:
    """Raise ConfigError for half a character, which only JSON can state: no name of a peer or of ROS has one."""
    if isinstance(value, list | tuple):
        for item in value:
            _check_text(place, item)
    elif isinstance(value, str):
        try:
            value.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError:
            raise ConfigError(f"{place}: found {value!r}, expected text that UTF-8 can encode") from None


def _pairs(place: str, value: Any) -> tuple[tuple[str, str], ...]:
    given = value if isinstance(value, list | tuple) else () if value is None else (value,)
    pairs = tuple(tuple(pair) if isinstance(pair, list | tuple) else (pair,) for pair in given)
    if not all(len(pair) == 2 and all(isinstance(text, str) for text in pair) for pair in pairs):
        raise ConfigError(f'{place}: found {value!r}, expected a table of strings such as {{ operator = "A. B." }}')
    return pairs


#: The settings that are globs: of the rows of a table, and lists of them.
_GLOBS = {"to_igtl": ("topic",), "to_ros": ("device", "type"), "peers": ("at",), "crtk": ("arms",)}
_GLOB_LISTS = ("deny_in", "deny_out", "allow_in", "allow_out", "mark_from")
_NUMBER_LISTS = frozenset({"workspace", "joint_min", "joint_max", "joint_speed"})
_TEXT_LISTS = frozenset(
    {"allow", "allow_in", "allow_out", "connect", "deny_in", "deny_out", "frames", "kinds", "listen", "mark_from"}
)
