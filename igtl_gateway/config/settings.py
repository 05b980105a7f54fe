"""The table of settings: options of ``bridge``, keys of the configuration file and parameters of the ROS node.

Each setting is one row (``config.setting``), whose name is also the key and the parameter.  ``SETTINGS`` are those of
the core; ``all_settings`` also has those of the add-ons, of ``settings.py`` in their folders.  What a recording has
is of the core: recordings outlive add-ons.

Rows of messages (``to_igtl``, ``to_ros``, ``tf_out``, ``peers``) are tables in a file.  As a parameter they are a list
of strings; ``app.rows`` has their form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from igtl_gateway.base.addons import ADDON_SETTINGS, check_setting, is_present, part_of
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import did_you_mean, near_names, one_of
from igtl_gateway.config import notations, triggers
from igtl_gateway.config.setting import (
    ARMS,
    BROWSERS,
    CLIENTS,
    GATEWAY,
    HOST,
    IGTL,
    NONE,
    RECORD,
    ROS_GRAPH,
    ROWS,
    Setting,
    Value,
    by_name,
    check_effect,
    grouped,
    unknown,
)
from igtl_gateway.convert.arms import PROFILE, arms_of_profile
from igtl_gateway.convert.choices import AUTO, KINDS, PROFILES, UNITS

#: Such a need → what to report if it is not there.
ABSENT = {
    ROS_GRAPH: "found --no-ros or --relay, expected neither",
    CLIENTS: "found --connect without --listen, expected --listen",
    ARMS: "found no --profile crtk, expected it",
    BROWSERS: "found no --listen ws://HOST:PORT or wss://HOST:PORT, expected one",
}

#: Settings of TLS.
TLS = ("tls", "tls_cert", "tls_key", "tls_ca")
#: Values of the setting ``profile``.
PROFILE_NAMES = (AUTO, *PROFILES)
#: Values of the setting ``stamp``: the sender's stamp, if it sent one, or the time of receipt.
SOURCE, RECEIVE = "source", "receive"
STAMP_POLICIES = (SOURCE, RECEIVE)
#: Codecs of the setting ``video_codec``; ``edges.video`` has them.
VIDEO_CODECS = ("h264", "vp9")

#: MiB that are kept of last images, and of last messages, beside the newest of them.
DEFAULT_KEEP_MIB = 48
#: MiB of latched messages: three of the largest usual volumes, of which DDS may have two each.
DEFAULT_LATCHED_MIB = 1536
#: The way of a robot and its network from a command to the state that shows it takes less.
DEFAULT_MAX_BEHIND_S = 0.2
#: Upper limit of the timeout of a COMMAND, s: one day.
MAX_TIMEOUT_S = 86_400.0

_YEAR_S = 365 * 86_400.0
_MANY = 1_000_000_000


def check_values(place: str, table: str, values: Mapping[str, object]) -> dict[str, Value]:
    """Return the values of a table of a file.  Raises ConfigError with the path of the setting, MissingAddon."""
    known = of_table(table)
    checked = {}
    for name, value in values.items():
        if name not in known:
            check_setting(name)
            if home := table_with(name):
                raise ConfigError(f"{place}.{name}: found in [{place}], expected in [{home}]")
            raise ConfigError(f"{place}.{name}: {unknown(name, known)}")
        try:
            checked[name] = known[name].check(value)
        except ConfigError as error:
            raise ConfigError(f"{place}.{name}: {error}") from None
    return checked


def check_needs(values: Mapping[str, Any], names: Iterable[str], *, ros: bool) -> None:
    """Raise ConfigError for settings that have no effect, because what they need is not there.

    Args:
        values: the values of all settings.
        names: settings that were given: each is expected to have an effect.
        ros: whether there is a ROS graph.
    """
    met = {
        ROS_GRAPH: ros,
        CLIENTS: bool(values["listen"] or values["relay"]) or not values["connect"],
        ARMS: bool(values["crtk"] or arms_of_profile(values["profile"])),
        BROWSERS: any(map(notations.uses_websocket, values["listen"])),
    }
    check_effect(by_name(all_settings()), values, names, met, ABSENT)


@cache
def all_settings() -> tuple[Setting, ...]:
    """Return the settings of the core and of the add-ons that are there, in the order of the documents."""
    rows = list(SETTINGS)
    for addon in ADDON_SETTINGS:
        if is_present(addon):
            rows += part_of(addon, "settings:SETTINGS")
    groups = list(dict.fromkeys(row.group for row in rows))
    return tuple(sorted(rows, key=lambda row: groups.index(row.group)))


def of_table(table: str) -> dict[str, Setting]:
    """Return the settings of a table of a file, by name."""
    # what a recording has does not wait for add-ons
    rows = SETTINGS if table in (GATEWAY, IGTL, ROWS) else all_settings()
    return {row.name: row for row in rows if row.table == table}


def table_with(name: str) -> str:
    """Return the table of a file that has this setting, "" if none or several have it."""
    tables = {row.table for row in all_settings() if row.name == name and row.table not in (NONE, ROWS)}
    return tables.pop() if len(tables) == 1 else ""


def parameters() -> dict[str, Setting]:
    """Return the settings that the ROS node has as parameters, by name."""
    return {row.name: row for row in all_settings() if row.parameter}


def _ros_kind(text: str) -> str:
    """Return a kind of ROS messages, or ``+`` and a kind.  Raises ConfigError."""
    if text.removeprefix("+") not in KINDS:
        kind = text.removeprefix("+")
        question = did_you_mean(near_names(kind, KINDS))
        expected = f"one of {', '.join(KINDS)}, also as +kind{question and f'; {question}'}"
        raise ConfigError(f"found {text!r}, expected {expected}")
    return text


def _profile(text: str) -> str:
    """Return the profile of peers, or ``crtk`` with its arms.  Raises ConfigError."""
    if arms_of_profile(text) is None and text not in PROFILE_NAMES:
        expected = one_of(text, (*PROFILE_NAMES, PROFILE, f"{PROFILE}:/NAMESPACE"))
        raise ConfigError(f"found {text!r}, expected {expected}")
    return text


_CONFIG = Setting(
    "config", "", "read the configuration from this file (TOML); options override it", metavar="FILE", common=True
)
_ADDRESSES = (
    Setting(
        "listen",
        (),
        "listen for OpenIGTLink clients on this address, with ws:// or wss:// (TLS) over WebSocket; port 0 selects a "
        "free port",
        IGTL,
        metavar="[tls://|ws://|wss://]HOST:PORT",
        reads=notations.listen_address,
        shown=f"{notations.DEFAULT_HOST}:{notations.DEFAULT_PORT}, unless --connect is given",
        common=True,
    ),
    Setting(
        "connect",
        (),
        "connect to the OpenIGTLink server at this address; reconnect until stopped",
        IGTL,
        metavar="[tls://]HOST:PORT",
        reads=notations.peer_address,
        common=True,
    ),
    Setting(
        "relay",
        False,
        "forward all bytes unchanged between each client of --listen and the server of --connect; without ROS",
        GATEWAY,
        parameter=False,
    ),
)
_SECURITY = (
    Setting(
        "allow",
        (),
        "accept clients from this network only, 'any' for all; required if --listen is not a loopback address",
        IGTL,
        metavar="CIDR",
        reads=notations.network,
        needs=(CLIENTS,),
        common=True,
    ),
    Setting(
        "clock_from",
        (),
        "ask peers at this address for their clock, once a second: other gateways, and programs that stamp each answer "
        "when they make it",
        IGTL,
        metavar="HOST:PORT",
        reads=notations.address_glob,
    ),
    Setting(
        "allow_origin",
        (),
        "over WebSocket, accept web pages of this origin, such as https://viewer.clinic, '*' for all; those of "
        "localhost are accepted",
        IGTL,
        metavar="ORIGIN",
        reads=notations.origin,
        needs=(BROWSERS,),
    ),
    Setting("tls", False, "use TLS at all addresses except those that begin with tcp:// or ws://", IGTL),
    Setting("tls_cert", "", "own certificate (PEM); turns TLS on for --listen", IGTL, metavar="FILE"),
    Setting(
        "tls_key",
        "",
        "private key of the certificate (PEM)",
        IGTL,
        metavar="FILE",
        shown="file of --tls-cert",
        needs=("tls_cert",),
    ),
    Setting(
        "tls_ca",
        "",
        "require a certificate of this CA (PEM) from clients and servers",
        IGTL,
        metavar="FILE",
    ),
    *(
        Setting(
            f"deny_{way}",
            (),
            f"{text}: COMMAND, 'GET_*', '*' for all",
            GATEWAY,
            metavar="TYPE",
            reads=notations.type_glob,
            changes=True,
            adds=True,
        )
        for way, text in (
            ("in", "reject messages of this type from peers"),
            ("out", "send no messages of this type"),
        )
    ),
    *(
        Setting(
            f"allow_{way}",
            (),
            f"{text}, such as {example}; * matches one level, ** any number",
            GATEWAY,
            metavar="DEVICE",
            reads=notations.device_glob,
            adds=True,
            needs=(ROS_GRAPH, ARMS),
        )
        for way, text, example in (
            (
                "in",
                "with a CRTK profile: let peers send this device to its topic",
                "PSM1/servo_cp or 'PSM1/move_*'",
            ),
            ("out", "with a CRTK profile: send this command of ROS to peers", "PSM1/servo_cp"),
        )
    ),
    Setting(
        "mark_from",
        (),
        "STRING and COMMAND Mark of this device make marks, such as 'suture-3: begins'",
        GATEWAY,
        metavar="DEVICE",
        reads=notations.any_device,
        adds=True,
    ),
    Setting(
        "cautious",
        True,
        "send peers that are not recognised, and show header version 1 only, no type at which common programs lose the "
        "stream",
        GATEWAY,
        "--no-cautious",
    ),
)
_LIMITS_OF_A_PEER = (
    Setting(
        "max_clients",
        32,
        "maximum number of connected clients",
        IGTL,
        metavar="N",
        least=1,
        most=1_000_000,
        needs=(CLIENTS,),
    ),
    Setting("queue_mib", 64, "size of the send queue", IGTL, metavar="MIB", unit="MiB", least=1, most=1 << 20),
    Setting("queue_messages", 4096, "number of messages in the send queue", IGTL, metavar="N", least=1, most=_MANY),
    Setting("max_body_mib", 256, "maximum body size", IGTL, metavar="MIB", unit="MiB", least=1, most=1 << 20),
    Setting(
        "max_body",
        (),
        "maximum body size of a message type or of 'GET_*'",
        IGTL,
        metavar="TYPE=MIB",
        unit="MiB",
        reads=notations.size_by_type,
        shown="2 for strings and poses, 16 for lists, 64 for VIDEO",
    ),
    Setting(
        "max_messages",
        100_000,
        "maximum rate of messages; a peer that sends faster is slowed down",
        IGTL,
        metavar="HZ",
        unit="Hz",
        least=1,
        most=_MANY,
    ),
    Setting(
        "stall_s",
        10.0,
        "longest pause inside a message",
        IGTL,
        metavar="SECONDS",
        unit="s",
        least=0.001,
        most=_YEAR_S,
    ),
    Setting(
        "min_rate_kib",
        8.0,
        "lowest transfer rate of a message",
        IGTL,
        metavar="KIB/S",
        unit="KiB/s",
        least=0.001,
        most=float(1 << 20),
    ),
    Setting(
        "idle_s",
        0.0,
        "close a link after this time without traffic in either direction; 0: never",
        IGTL,
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        shown="0",
    ),
)
_PEERS_AND_MESSAGES = (
    Setting(
        "profile",
        AUTO,
        f"profile of all peers: {', '.join(PROFILE_NAMES)}; crtk or crtk:/NAMESPACE: auto, with the CRTK topics of the "
        "arms at these namespaces (* matches one level)",
        GATEWAY,
        metavar="PROFILE",
        choices=(*PROFILE_NAMES, PROFILE),
        reads=_profile,
        shown=f"{AUTO}, detected from their messages",
        common=True,
    ),
    Setting(
        "crtk",
        (),
        "the arms at these namespaces have CRTK topics; a row also has the limits of commands to them",
        ROWS,
        "",
        metavar="NAMESPACE",
        adds=True,
        needs=(ROS_GRAPH,),
    ),
    Setting(
        "peers",
        (),
        "profile of the server at this address, or of clients that connect to this address",
        ROWS,
        "--peer",
        metavar="HOST:PORT=PROFILE",
        adds=True,
    ),
    Setting(
        "to_igtl",
        (),
        "send this ROS topic to OpenIGTLink as this device and message type",
        ROWS,
        "--send",
        metavar="TOPIC[=DEVICE[:TYPE]]",
        adds=True,
        needs=(ROS_GRAPH,),
        common=True,
    ),
    Setting(
        "tf_out",
        (),
        "send the poses of frames in BASE, from /tf and /tf_static: one frame as TRANSFORM, several as TDATA",
        ROWS,
        metavar="FRAME[,FRAME…]:BASE[=DEVICE[:TYPE]]",
        adds=True,
        needs=(ROS_GRAPH,),
        common=True,
    ),
    Setting(
        "to_ros",
        (),
        "publish these messages of a device instead of the default ones, or with +KIND in addition to them; "
        "DEVICE: * matches one level, ** any number",
        ROWS,
        "--kinds",
        metavar="DEVICE=KIND[,KIND…]",
        adds=True,
        needs=(ROS_GRAPH,),
    ),
    Setting(
        "kinds",
        (),
        "default of to_ros: publish these messages of devices instead of the default ones, or with +KIND in addition",
        GATEWAY,
        "",
        reads=_ros_kind,
        changes=True,
    ),
    Setting(
        "max_age_s",
        0.0,
        "default of to_igtl, to_ros and tf_out: withhold messages that are older on arrival; 0: no limit",
        GATEWAY,
        "",
        unit="s",
        least=0,
        most=_YEAR_S,
        changes=True,
    ),
)
_ROS = (
    Setting("publish_tf", True, "publish poses on /tf", GATEWAY, "--no-tf", needs=(ROS_GRAPH,)),
    Setting("base_frame", "igtl", "frame of messages that do not name a frame", GATEWAY, ""),
    Setting("ros_unit", "m", "length unit of ROS messages", GATEWAY, "", choices=UNITS),
    Setting("igtl_unit", "mm", "length unit of OpenIGTLink messages", GATEWAY, "", choices=UNITS),
    Setting(
        "stamp",
        SOURCE,
        "stamp of a converted message: source: the sender's, if it sent one; receive: the gateway time of receipt",
        GATEWAY,
        "",
        choices=STAMP_POLICIES,
    ),
    Setting("check_crc", True, "reject messages whose CRC is wrong", GATEWAY, ""),
    Setting(
        "max_streams",
        512,
        "maximum number of streams of one session in each direction",
        GATEWAY,
        "",
        least=1,
        most=_MANY,
    ),
    Setting(
        "keep_mib",
        DEFAULT_KEEP_MIB,
        "memory for the last images of all devices, of which later ones may be parts, and as much for the last "
        "messages of ROS topics, for queries; the newest and latched ones do not count, the oldest are forgotten",
        GATEWAY,
        metavar="MIB",
        unit="MiB",
        least=1,
        most=1 << 20,
    ),
    Setting(
        "latched_mib",
        DEFAULT_LATCHED_MIB,
        "memory for the latched messages of all topics, which late joiners get, in each direction; beyond it those of "
        "the topic that has most are forgotten: who joins gets none before the next",
        GATEWAY,
        metavar="MIB",
        unit="MiB",
        least=1,
        most=1 << 20,
    ),
    Setting(
        "max_behind_s",
        DEFAULT_MAX_BEHIND_S,
        "how far a stream of commands may be from the measured state of its arm, as a time at the speed limits; 0: any "
        "distance",
        GATEWAY,
        "",
        unit="s",
        least=0,
        most=3600,
    ),
    Setting(
        "command_timeout_s",
        5.0,
        "time after which a COMMAND without a reply has failed",
        GATEWAY,
        "",
        unit="s",
        least=0,
        most=MAX_TIMEOUT_S,
        open_ends=True,
    ),
)
_RECORDING = (
    Setting(
        "record",
        "",
        "record all messages to this MCAP file; {time} in its name becomes the start in UTC",
        metavar="FILE",
        reads=notations.recording_name,
        common=True,
    ),
    Setting("overwrite", False, "overwrite an existing recording", needs=("record",), common=True),
    Setting(
        "file_mode",
        "0600",
        "mode of the files that it writes; directories may also be entered by those who may read files",
        metavar="MODE",
        reads=notations.file_mode,
        needs=("record",),
    ),
    Setting(
        "record_topics",
        (),
        "also record these ROS topics, in addition to the bridged ones; * matches one level, ** any number; hidden "
        "ones by a level with _, as /fib/_action/**",
        metavar="GLOB",
        needs=("record", ROS_GRAPH),
        common=True,
        words=True,
    ),
    Setting(
        "record_all",
        False,
        "also record all ROS topics, services and actions",
        needs=("record", ROS_GRAPH),
        common=True,
    ),
    Setting(
        "record_include",
        (),
        f"record only inputs of these streams and their outputs; {notations.STREAM}",
        metavar="GLOB",
        needs=("record",),
        words=True,
    ),
    Setting(
        "record_exclude",
        (),
        "do not record inputs of these streams and their outputs",
        metavar="GLOB",
        needs=("record",),
        words=True,
    ),
    Setting(
        "custom_data",
        (),
        "add this key and value to the metadata of the recording, such as operator=Kim",
        metavar="KEY=VALUE",
        reads=notations.key_value,
        needs=("record",),
        words=True,
    ),
    Setting(
        "compression",
        "lz4",
        "compression of chunks; auto: by stream, zstd for pictures; what does not shrink is stored uncompressed",
        choices=("auto", "none", "lz4", "zstd"),
        needs=("record",),
    ),
    Setting(
        "outputs",
        "full",
        "large outputs in the recording: all bytes, which other programs read; the digest, from which igtl-gateway "
        "computes them; or none",
        choices=("full", "digest", "none"),
        needs=("record",),
    ),
    Setting(
        "flush_interval",
        0.5,
        "interval between flushes: what a kill of bridge and recorder can lose; a crash of the bridge loses nothing",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        needs=("record",),
    ),
    Setting(
        "fsync",
        "never",
        "when to force data to the disk: a power failure then loses one interval (flush) or open files (close)",
        choices=("never", "flush", "close"),
        needs=("record",),
    ),
    Setting(
        "record_wait",
        False,
        "begin FILE when the recording is started: key r, the page or the ROS service ~/start_recording",
        needs=("record",),
    ),
    Setting(
        "split_size",
        0,
        "start a new file after this size",
        metavar="MIB",
        unit="MiB",
        least=0,
        most=1 << 30,
        needs=("record",),
    ),
    Setting(
        "split_duration",
        0.0,
        "start a new file after this time",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        needs=("record",),
    ),
    Setting(
        "snapshot",
        0.0,
        "record to memory, and write the last SECONDS to FILE_<UTC time>.mcap on key s, SIGUSR1 or the ROS service "
        "~/snapshot",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        needs=("record",),
    ),
    Setting(
        "trigger",
        (),
        "with --snapshot: also write them when this happens, see docs/how-to/black-box.md",
        metavar="RULE",
        reads=triggers.trigger,
        needs=("snapshot",),
        adds=True,
    ),
    Setting(
        "seal",
        "",
        "sign the recording with this private key (Ed25519, PEM) while it is written; `seal keys new` makes one",
        metavar="KEY",
        needs=("record",),
    ),
    Setting(
        "retention",
        "",
        "delete closed recordings in the directory of FILE, the oldest first: by age (h, d, w), by size of all "
        "(MB, GB, TB, MiB, GiB, TiB) or by both, such as '30 d, 200 GB'",
        RECORD,
        metavar="RULE",
        reads=notations.retention,
        needs=("record",),
    ),
    Setting(
        "on_record_failure",
        "continue",
        "what the bridge does if the recording fails, for example if the disk is full",
        choices=("continue", "stop"),
        needs=("record",),
    ),
)
_VIDEO = (
    Setting(
        "video_codec",
        "",
        "encode ROS images that are sent as VIDEO, and decode received VIDEO to ROS images",
        choices=("", *VIDEO_CODECS),
        needs=(ROS_GRAPH,),
    ),
    Setting(
        "video_bit_rate",
        4000,
        "with --video-codec: bit rate of a stream",
        metavar="KBIT/S",
        unit="kbit/s",
        least=10,
        most=1_000_000,
        needs=("video_codec",),
    ),
    Setting(
        "video_key_interval",
        30,
        "with --video-codec: frames from one key frame to the next",
        metavar="N",
        least=1,
        most=10_000,
        needs=("video_codec",),
    ),
)
_SCHEDULING = (
    Setting(
        "realtime_priority",
        0,
        "run the threads that pass messages with SCHED_FIFO at this priority, 1 (lowest) to 99; needs CAP_SYS_NICE or "
        "RLIMIT_RTPRIO",
        HOST,
        metavar="N",
        least=0,
        most=99,
    ),
    Setting(
        "lock_memory",
        False,
        "keep the used memory of the bridge from being paged out; needs CAP_IPC_LOCK or RLIMIT_MEMLOCK",
        HOST,
    ),
    Setting(
        "cpu_affinity",
        "",
        "run the threads that pass messages on these CPUs only, for example 2,4-6",
        HOST,
        metavar="LIST",
        reads=notations.cpus,
    ),
)
_DIAGNOSTICS = (
    Setting("diagnostics", True, "publish on /diagnostics", option="--no-diagnostics", needs=(ROS_GRAPH,)),
    Setting("watch", True, "report jumps and implausible stamps", GATEWAY, "--no-watch"),
    Setting(
        "metrics",
        "",
        "serve counts, rates and queue lengths over HTTP: /metrics for Prometheus, /status as JSON",
        metavar="[HOST:]PORT",
        reads=notations.address,
        common=True,
        keyword=False,
    ),
)
_FAULT_INJECTION = (
    Setting(
        "faults",
        "",
        "apply these faults to the OpenIGTLink messages",
        GATEWAY,
        "--fault",
        metavar="NAME=VALUE[,…]",
        parameter=False,
        needs=("relay",),
    ),
    Setting(
        "fault_seed",
        0,
        "seed of the fault injection; the same seed affects the same messages",
        GATEWAY,
        "--seed",
        metavar="N",
        shown="0",
        parameter=False,
        needs=("faults",),
    ),
)

#: All settings, in the order of the documents, each with its group in the help.
SETTINGS: tuple[Setting, ...] = (
    _CONFIG,
    *grouped("addresses", *_ADDRESSES),
    *grouped("security", *_SECURITY),
    *grouped("limits of a peer", *_LIMITS_OF_A_PEER),
    *grouped("peers and messages", *_PEERS_AND_MESSAGES),
    *grouped("ROS", *_ROS),
    *grouped("recording", *_RECORDING),
    *grouped("video (needs PyAV)", *_VIDEO),
    *grouped("scheduling", *_SCHEDULING),
    *grouped("diagnostics", *_DIAGNOSTICS),
    *grouped("fault injection", *_FAULT_INJECTION),
)

BY_SETTING = by_name(SETTINGS)
