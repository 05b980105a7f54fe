"""``igtl-gateway bridge``: the gateway, live, until Ctrl-C."""

from __future__ import annotations

import argparse
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from igtl_gateway.app.bridge import Address, Bridge, BridgeOptions
from igtl_gateway.app.interpreter import tune_interpreter
from igtl_gateway.app.status import BridgeStatus
from igtl_gateway.cli import admission, realtime, recording, routes
from igtl_gateway.cli.bridge_output import BridgeOutput, EntryWatch, JsonOutput, TextOutput
from igtl_gateway.cli.common import load_config, stop_event
from igtl_gateway.cli.edge_file import with_file_settings
from igtl_gateway.cli.options import (
    DEFAULT_HOST,
    DEFAULT_PORT,
    add_addresses,
    add_allow,
    add_config,
    add_faults,
    address,
    addresses,
    default,
)
from igtl_gateway.cli.terminal import is_terminal, print_line
from igtl_gateway.cli.type_tables import types
from igtl_gateway.clock import SystemClock
from igtl_gateway.config import Config
from igtl_gateway.edges.ros.env import prepare_environment, tune_malloc
from igtl_gateway.edges.video import CODECS, VideoOptions
from igtl_gateway.errors import ConfigError, ViewerError
from igtl_gateway.extras import missing
from igtl_gateway.faults import RelayFaults
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.stamp import NS_PER_S

if TYPE_CHECKING:
    from igtl_gateway.app.metrics import MetricsServer
    from igtl_gateway.view.live import LiveWindow

EXAMPLES = """\
  # OpenIGTLink server on 127.0.0.1:18944, ROS 2 node /igtl_gateway
  igtl-gateway bridge
  # record all messages
  igtl-gateway bridge --record out.mcap
  # connect to a PLUS server
  igtl-gateway bridge --connect 127.0.0.1:18945
  # accept clients of one network
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow 192.168.7.0/24
  # accept clients that have a certificate of the clinic
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow any \\
      --tls-cert or1.pem --tls-ca clinic.pem
  # peers receive messages but cannot send any
  igtl-gateway bridge --deny-in '*'
  # send a ROS topic to OpenIGTLink as device Camera
  igtl-gateway bridge --send /camera/image_raw=Camera
  # send the pose of a robot's tool as device tool0Tobase_link
  igtl-gateway bridge --tf-out tool0:base_link
  # send images as encoded VIDEO
  igtl-gateway bridge --video-codec h264
  # show the session live in rerun
  igtl-gateway bridge --view
  # record OpenIGTLink without ROS
  igtl-gateway bridge --no-ros --record slicer.mcap
  # start a new file after each GiB, in the directory long
  igtl-gateway bridge --record long.mcap --split-size 1024
  # save the last 30 s whenever key s is pressed
  igtl-gateway bridge --record last.mcap --snapshot 30
  # record the traffic between two OpenIGTLink programs
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 \\
      --record talk.mcap
  # delay their messages by 50 ms and drop 1 % of them
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 \\
      --fault delay=50ms,loss=1% --seed 7
  # counts for Prometheus at http://127.0.0.1:9464/metrics
  igtl-gateway bridge --metrics 9464

Messages of a device are published on /igtl/in/<device>/<kind>.  Messages that
are published on /igtl/out/<device> are sent to the peers."""

_STATUS_EVERY_S = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser, "read the configuration from this file (TOML); options override it")
    parser.add_argument("--duration", type=float, metavar="SECONDS", help="stop after this time")
    parser.add_argument("--types", action="store_true", help="list all conversions of message types, then exit")
    group = parser.add_argument_group("addresses")
    add_addresses(group, admission.peer_address, "[tls://]HOST:PORT")
    group.add_argument(
        "--relay",
        action="store_true",
        help="forward all bytes unchanged between each client of --listen and the server of --connect; without ROS",
    )
    group = parser.add_argument_group("security")
    add_allow(group)
    admission.add_tls(group)
    routes.add_denials(group)
    admission.add_limits(parser.add_argument_group("limits of a peer"))
    group = parser.add_argument_group("peers and messages")
    routes.add_peers(group)
    routes.add_messages(group)
    group = parser.add_argument_group("ROS")
    routes.add_topics(group)
    group.add_argument("--no-ros", action="store_true", help="run without ROS, for OpenIGTLink only")
    group.add_argument(
        "--node-name", default="igtl_gateway", metavar="NAME", help="name of the ROS node " + default("igtl_gateway")
    )
    _add_video(parser.add_argument_group("video (needs PyAV)"))
    recording.add_arguments(parser.add_argument_group("recording"))
    realtime.add_arguments(parser.add_argument_group("scheduling"))
    _add_diagnostics(parser.add_argument_group("diagnostics"))
    add_faults(
        parser,
        [
            "With --relay only.  in:NAME=VALUE applies to messages of clients to the",
            "server, out:NAME=VALUE to messages of the server to clients.",
        ],
    )


def _add_video(group: argparse._ArgumentGroup) -> None:
    video = VideoOptions()
    group.add_argument(
        "--video-codec",
        choices=CODECS,
        help="encode ROS images that are sent as VIDEO, and decode received VIDEO to ROS images",
    )
    group.add_argument(
        "--video-bit-rate",
        type=int,
        default=video.bit_rate // 1000,
        metavar="KBIT/S",
        help="with --video-codec: bit rate of a stream " + default(video.bit_rate // 1000),
    )
    group.add_argument(
        "--video-key-interval",
        type=int,
        default=video.key_frame_interval,
        metavar="N",
        help="with --video-codec: frames from one key frame to the next " + default(video.key_frame_interval),
    )


def _add_diagnostics(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--no-diagnostics", action="store_true", help="do not publish on /diagnostics")
    group.add_argument("--no-watch", action="store_true", help="do not report jumps and implausible stamps")
    group.add_argument("--view", action="store_true", help="show all messages live in the window of rerun")
    group.add_argument(
        "--metrics",
        type=address,
        metavar="[HOST:]PORT",
        help="serve counts, rates and queue lengths over HTTP: /metrics for Prometheus, /status as JSON",
    )
    group.add_argument(
        "--log-format",
        choices=("text", "json"),
        default="text",
        help="format of the output; json: one object per line, with its time " + default("text"),
    )
    group.add_argument(
        "--json", dest="log_format", action="store_const", const="json", help="same as --log-format json"
    )


def run(options: argparse.Namespace) -> int:
    if options.types:
        print_line(*types())
        return 0
    how = recording.record_options(options)
    if options.duration is not None and not 0 < options.duration < float("inf"):
        raise ConfigError(f"--duration: found {options.duration:g}, expected a number of seconds above 0")
    options = with_file_settings(options, options.config)
    config, bridge_options = _settings(options, how)
    watch = EntryWatch()
    clock = SystemClock()
    with stop_event() as stop:
        notes = [tune_malloc()] if options.no_ros else prepare_environment()
        window = _window(config) if options.view else None
        bridge = Bridge(config, bridge_options, clock, watch, window, watch.add)
        status = BridgeStatus(bridge, watch, clock)
        metrics = _start(bridge, options, status, window)
        out: BridgeOutput = JsonOutput(clock) if options.log_format == "json" else TextOutput(is_terminal())
        started_ns = clock.monotonic_ns()
        try:
            with recording.recording_controls(bridge.recorder) as keys:
                out.started(bridge, config, [note for note in (*notes, bridge.realtime, keys) if note], metrics)
                tune_interpreter()
                while not stop.wait(_STATUS_EVERY_S):
                    out.events(watch.take())
                    seconds = (clock.monotonic_ns() - started_ns) / NS_PER_S
                    bridge.collect()
                    out.status(bridge, watch, seconds)
                    if metrics:
                        status.sample()
                    if bridge.has_failed or (options.duration and seconds >= options.duration):
                        break
        finally:
            if metrics:
                metrics.close()
            bridge.stop()
            viewer_problem = window.close() if window else ""
        out.events(watch.take())
        out.stopped(bridge, watch)
        if viewer_problem:
            print_line(f"igtl-gateway bridge: --view: {viewer_problem}", error=True)
    return 1 if bridge.summary and bridge.summary.failure else 0


def _settings(options: argparse.Namespace, how: RecordOptions) -> tuple[Config, BridgeOptions]:
    """Configuration of the session, and options of the bridge.  Raises ConfigError."""
    listen, connect = addresses(options)
    config = routes.with_routes(load_config(options.config), options)
    config = replace(config, watch=False) if options.no_watch else config.watched()
    if options.relay or config.relay:
        config, listen = _relayed(config, options, listen, connect)
        options.no_ros = True
    elif options.fault:
        raise ConfigError("--fault: found no --relay, expected it: only a relay has a connection to inject faults into")
    tls_listen, tls_connect = admission.secured(options, listen, connect)
    return config, BridgeOptions(
        listen,
        connect,
        ros=not options.no_ros,
        record=options.record,
        record_topics=("**",) if options.record_all else tuple(options.record_topics),
        allow=tuple(options.allow),
        limits=admission.limits(options),
        tls=admission.tls(options),
        tls_listen=tls_listen,
        tls_connect=tls_connect,
        node_name=options.node_name,
        recording=how,
        video=_video(options),
        diagnostics=not (options.no_ros or options.no_diagnostics),
        reserved=options.reserved,
        realtime=realtime.realtime_options(options, options.config),
    )


def _start(
    bridge: Bridge, options: argparse.Namespace, status: BridgeStatus, window: LiveWindow | None
) -> MetricsServer | None:
    """Start the bridge, and the server of ``--metrics``; close all where one of them cannot start."""
    metrics: MetricsServer | None = None
    try:
        if options.metrics:  # before the recording: a port in use must not cost an existing recording
            metrics = _metrics(options, status)
        bridge.start()
        if metrics:
            status.sample()
    except Exception:
        if metrics:
            metrics.close()
        if window:
            window.close()
        raise
    return metrics


def _relayed(
    config: Config, options: argparse.Namespace, listen: tuple[Address, ...], connect: tuple[Address, ...]
) -> tuple[Config, tuple[Address, ...]]:
    """Return configuration and listening addresses of a relay."""
    if len(connect) != 1:
        raise ConfigError(f"--relay: found {len(connect)} servers, expected one: --connect HOST:PORT")
    if RelayFaults.parse(options.fault):
        config = replace(config, relay=True, faults=options.fault, fault_seed=options.seed)
    return replace(config, relay=True), listen or ((DEFAULT_HOST, DEFAULT_PORT),)


def _video(options: argparse.Namespace) -> VideoOptions | None:
    if not options.video_codec:
        return None
    if options.no_ros:
        raise ConfigError("--video-codec: found --no-ros, expected ROS: the codec encodes images of ROS")
    return VideoOptions(options.video_codec, options.video_bit_rate * 1000, options.video_key_interval)


def _metrics(options: argparse.Namespace, status: BridgeStatus) -> MetricsServer:
    from igtl_gateway.app.metrics import MetricsServer

    host, port = options.metrics
    status.sample()
    return MetricsServer(host, port, status, tuple(options.allow))


def _window(config: Config) -> LiveWindow:
    if find_spec("rerun") is None:
        raise ViewerError(missing("rerun"))
    from igtl_gateway.view.live import LiveWindow

    return LiveWindow(config)
