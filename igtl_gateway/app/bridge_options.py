"""The options of a bridge, and how they follow from its settings: addresses, TLS, limits, recording, codec."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from igtl_gateway.app.setting_values import config_of
from igtl_gateway.app.subscriptions import EVERYTHING
from igtl_gateway.base.addons import part_of
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.realtime import RealtimeOptions
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import (
    DDS,
    DEFAULT_HOST,
    DEFAULT_PORT,
    cpus,
    file_mode,
    key_value,
    listen_address,
    peer_address,
    retention,
    size_by_type,
    uses_tls,
)
from igtl_gateway.config.settings import all_settings, check_needs
from igtl_gateway.config.triggers import KINDS, Trigger, trigger
from igtl_gateway.edges.reserved import ReservedPorts
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.edges.video import VideoOptions
from igtl_gateway.record.options import TIME, RecordOptions, path_at
from igtl_gateway.record.selection import Selection

_NEVER = TlsFiles()

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """This site, and what its gateway sends over Zenoh.

    Attributes:
        name: of the site; "": none.
        bytes_per_s: budget; 0: no limit.
        classes: ``GLOB=CLASS`` for topics.
    """

    name: str = ""
    bytes_per_s: int = 0
    classes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BridgeOptions:
    """Options of the command line that do not influence the content of messages.

    Attributes:
        listen, connect: addresses of the OpenIGTLink side; a relay connects to one server.
        ros: join the ROS 2 graph.
        zenoh: join it over Zenoh, by the router at this endpoint ("": that of Zenoh's configuration); None: over DDS.
        site: name of this site, and what it may send.
        record: file of the recording, with ``{time}`` until `at`; None: record nothing.
        record_topics: globs of ROS topics that are recorded in addition to the bridged ones.
        allow: networks (CIDR) whose peers may connect in addition to those of this host.
        limits: limits for each peer.
        tls: files for TLS.
        tls_listen, tls_connect: the addresses of ``listen`` and ``connect`` that use TLS.
        origins: whose web pages may connect over WebSocket, beside those of this machine.
        node_name: name of the ROS node.
        recording: options of the recorder.
        upload: where closed recordings are copied to; "": nowhere.
        upload_rate: bytes per second of it; 0: no limit.
        video: options of the codec from ROS images to VIDEO and back; None: neither encode nor decode.
        diagnostics: publish the state of the bridge on /diagnostics once a second.
        realtime: scheduling of the threads that pass messages.
        native: let messages of compiled streams pass natively, where that is possible.
    """

    listen: tuple[Address, ...] = ()
    connect: tuple[Address, ...] = ()
    ros: bool = True
    zenoh: str | None = None
    site: SiteOptions = SiteOptions()
    record: Path | None = None
    record_topics: tuple[str, ...] = ()
    allow: tuple[str, ...] = ()
    clock_from: tuple[str, ...] = ()
    limits: PeerLimits = field(default_factory=PeerLimits)
    tls: TlsFiles = field(default_factory=TlsFiles)
    tls_listen: frozenset[Address] = frozenset()
    tls_connect: frozenset[Address] = frozenset()
    origins: tuple[str, ...] = ()
    node_name: str = "igtl_gateway"
    recording: RecordOptions = field(default_factory=RecordOptions)
    upload: str = ""
    upload_rate: float = 0.0
    video: VideoOptions | None = None
    diagnostics: bool = False
    reserved: ReservedPorts | None = None
    realtime: RealtimeOptions = field(default_factory=RealtimeOptions)
    native: bool = True

    def at(self, utc_ns: int) -> BridgeOptions:
        """Return the options of a session that starts at this time: ``{time}`` in the name of its file is replaced."""
        if self.record is None or TIME not in str(self.record):
            return self
        recording = replace(self.recording, named=self.record)
        return replace(self, record=path_at(self.record, utc_ns), recording=recording)


def bridge_options(
    values: Mapping[str, Any],
    *,
    ros: bool,
    node_name: str,
    given: Iterable[str] = (),
    reserved: ReservedPorts | None = None,
) -> tuple[Config, BridgeOptions]:
    """Return the configuration of the session and the options of the bridge.

    Args:
        values: the values of all settings.
        ros: join the ROS graph; a relay does not.
        node_name: name of the ROS node.
        given: settings of this call: unlike those of a file, each of them must have an effect.
        reserved: ports that are taken already.

    Raises:
        ConfigError: settings that contradict each other, or have no effect.
    """
    ros = ros and not values["relay"]
    check_needs(values, (*given, *_of_a_recording(values)), ros=ros)
    config = config_of(values)
    how = record_options(values)
    listen, connect = addresses(values["listen"], values["connect"])
    if config.relay:
        if len(connect) != 1:
            raise ConfigError(f"--relay: found {counted(len(connect), 'server')}, expected one: --connect HOST:PORT")
        if config.mark_from:
            raise ConfigError("--mark-from: found --relay, expected one of them: a relay reads no messages")
        if values["clock_from"]:
            raise ConfigError("--clock-from: found --relay, expected one of them: a relay sends no messages of its own")
        listen = listen or ((DEFAULT_HOST, DEFAULT_PORT),)
    if "peers" in given:
        _check_peers(config, (*listen, *connect))
    tls_listen, tls_connect = secured(values, listen, connect)
    return config, BridgeOptions(
        listen,
        connect,
        ros=ros,
        zenoh=zenoh_endpoint(values) if ros else None,
        site=_site(values),
        record=Path(values["record"]) if values["record"] else None,
        record_topics=(
            *(EVERYTHING if values["record_all"] else ()),
            *values["record_topics"],
            *_watched(how.triggers, ros=ros),
        ),
        allow=tuple(values["allow"]),
        clock_from=tuple(values["clock_from"]),
        limits=limits(values),
        tls=tls(values),
        tls_listen=tls_listen,
        tls_connect=tls_connect,
        origins=tuple(values["allow_origin"]),
        node_name=node_name,
        recording=how,
        upload=values.get("upload", ""),
        upload_rate=values.get("upload_rate", 0.0) * 1e6,
        video=_video(values, ros=ros),
        diagnostics=ros and values["diagnostics"],
        reserved=reserved,
        realtime=RealtimeOptions(
            values["realtime_priority"],
            values["lock_memory"],
            cpus(values["cpu_affinity"]) if values["cpu_affinity"] else frozenset(),
        ),
    )


def _check_peers(config: Config, places: Sequence[Address]) -> None:
    """Raise ConfigError for the profile of an address that no link has: another port, or none.

    A host has many names, and port 0 is any.
    """
    ports = {port for _, port in places}
    for row in config.peers:
        port = whole_number(row.at.rpartition(":")[2])
        is_absent = port not in ports and 0 not in ports if port is not None else not set(row.at) & set(":*?[")
        if is_absent:
            usual = ", ".join(f"{host}:{port}" for host, port in places)
            raise ConfigError(f"--peer: found {row.at}, expected an address of --listen or --connect: {usual}")


def zenoh_endpoint(values: Mapping[str, Any]) -> str | None:
    """Return the endpoint of the router, "" for that of Zenoh's configuration, None for DDS."""
    way = values.get("ros", DDS)
    endpoint: str | None = None if way == DDS else part_of("zenoh", "notation:ros_middleware")(way)
    return endpoint


def _site(values: Mapping[str, Any]) -> SiteOptions:
    """Return the options of the site.  Raises ConfigError."""
    if "site" not in values:  # without the add-on
        return SiteOptions()
    if values["site"] and zenoh_endpoint(values) is None:
        raise ConfigError(f"--site {values['site']}: found --ros {values['ros']}, expected --ros zenoh")
    return SiteOptions(values["site"], values["site_budget"] << 10, tuple(values["site_classes"]))


def addresses(
    listening: Iterable[str | tuple[str, int]], servers: Iterable[str | tuple[str, int]]
) -> tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...]]:
    """Return (listen, connect) for checked strings or pairs, with the default server if there are none."""
    listen, connect = (
        tuple(reads(place) if isinstance(place, str) else place for place in places)
        for reads, places in ((listen_address, listening), (peer_address, servers))
    )
    if twice := next((place for place in listen if place[1] and listen.count(place) > 1), None):
        raise ConfigError(f"--listen: found {twice[0]}:{twice[1]} twice, expected each port once")
    return listen if listen or connect else ((DEFAULT_HOST, DEFAULT_PORT),), connect


def limits(values: Mapping[str, Any]) -> PeerLimits:
    """Return the limits of a peer.  Raises ConfigError."""
    return PeerLimits(
        max_clients=values["max_clients"],
        queue_bytes=values["queue_mib"] << 20,
        queue_messages=values["queue_messages"],
        stall_s=values["stall_s"],
        min_rate=round(values["min_rate_kib"] * 2**10),
        idle_s=values["idle_s"],
        max_body=values["max_body_mib"] << 20,
        bodies=tuple(map(size_by_type, values["max_body"])),
        messages_per_s=values["max_messages"],
    )


def _watched(rules: Iterable[Trigger], *, ros: bool) -> list[str]:
    """Return the topics that rules look at.  Raises ConfigError for a rule that has no effect."""
    watched = [(rule, KINDS[rule.kind]) for rule in rules]
    for rule, row in watched:
        if row.only_ros and not ros:
            raise ConfigError(
                f"--trigger {rule.kind}: found --no-ros or --relay, expected neither: the rule has no effect"
            )
    return list(dict.fromkeys(row.topics.format(rule.pattern) for rule, row in watched if row.topics))


def tls(values: Mapping[str, Any]) -> TlsFiles:
    """Return the files of TLS."""
    return TlsFiles(*(Path(values[name]) if values[name] else None for name in ("tls_cert", "tls_key", "tls_ca")))


def secured(
    values: Mapping[str, Any], listen: Sequence[tuple[str, int]], connect: Sequence[tuple[str, int]]
) -> tuple[frozenset[tuple[str, int]], frozenset[tuple[str, int]]]:
    """Return the addresses with TLS: (listening, servers).  Raises ConfigError for files or ``--tls`` without one.

    A certificate turns TLS on for all listening addresses except those with ``tcp://`` or ``ws://``: a user who gives
    one must not discover later that the traffic was not encrypted.
    """
    ours = _with_tls(listen, values["tls"] or bool(values["tls_cert"]))
    servers = _with_tls(connect, values["tls"])
    if tls(values) != _NEVER and not ours and not servers:
        raise ConfigError("--tls-ca, --tls-cert: found no address with TLS, expected --tls or tls://HOST:PORT")
    if values["tls"] and (listen or connect) and not ours and not servers:
        raise ConfigError("--tls: found only addresses with tcp:// or ws://, expected one with TLS")
    return ours, servers


def _with_tls(places: Iterable[tuple[str, int]], usual: bool) -> frozenset[tuple[str, int]]:
    return frozenset(place for place in places if uses_tls(place, usual))


def _of_a_recording(values: Mapping[str, Any]) -> list[str]:
    """Return the changed settings of a recording, also those of a file: a lost recording is no detail."""
    return [row.name for row in all_settings() if "record" in row.needs and values[row.name] != row.default]


def record_options(values: Mapping[str, Any]) -> RecordOptions:
    """Return the options of the recording for the values of all settings.  Raises ConfigError."""
    if values["snapshot"] and (values["split_size"] or values["split_duration"]):
        raise ConfigError("--snapshot: found --split-size or --split-duration, expected neither: it records to memory")
    if values["snapshot"] and values["record_wait"]:
        raise ConfigError("--record-wait: found --snapshot, expected one of them: it writes on request only")
    rules = tuple(map(trigger, values["trigger"]))
    for rule in rules:
        if rule.before_s is not None and rule.before_s > values["snapshot"]:
            raise ConfigError(
                f"--trigger {rule}: found before={rule.before_s:g}, expected at most --snapshot, {values['snapshot']:g}"
            )
    return RecordOptions(
        compression=values["compression"],
        outputs=values["outputs"],
        flush_s=values["flush_interval"],
        fsync=values["fsync"],
        split_bytes=values["split_size"] << 20,
        split_s=values["split_duration"],
        snapshot_s=values["snapshot"],
        triggers=rules,
        selection=Selection(tuple(values["record_include"]), tuple(values["record_exclude"])),
        overwrite=values["overwrite"],
        waits=values["record_wait"],
        stop_on_failure=values["on_record_failure"] == "stop",
        custom=tuple(map(key_value, values["custom_data"])),
        file_mode=file_mode(values["file_mode"]),
        seal=Path(values["seal"]) if values["seal"] else None,
        retention=retention(values["retention"]) if values["retention"] else None,
        uploaded=bool(values.get("upload")),
    )


def _video(values: Mapping[str, Any], *, ros: bool) -> VideoOptions | None:
    if not values["video_codec"]:
        return None
    if not ros:
        raise ConfigError("--video-codec: found --no-ros, expected ROS: the codec encodes images of ROS")
    return VideoOptions(values["video_codec"], values["video_bit_rate"] * 1000, values["video_key_interval"])
