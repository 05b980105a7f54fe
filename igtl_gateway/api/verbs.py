"""The verbs of the command line as functions: ``replay_recording``, ``verify``, ``diff``.

Each calls the function that its verb calls.  Nothing prints; a failure is an exception of `igtl_gateway.base.errors`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import get_args

from igtl_gateway.api.endpoint import HOST, PORT
from igtl_gateway.api.keywords import addresses, numbers, of_a_replay, one_of, ros_arguments, texts
from igtl_gateway.api.recording import Recording, session_of
from igtl_gateway.app.comparison import RecordingDiff, compare_sessions
from igtl_gateway.app.replay_sides import ReplayOptions, To
from igtl_gateway.app.replaying import ReplayEvents, ReplayResult, run_replay
from igtl_gateway.app.verification import Verification, verify_session
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.config.settings import PROFILE_NAMES
from igtl_gateway.convert.profiles import AUTO
from igtl_gateway.edges.tcp import TlsFiles
from igtl_gateway.replay.compare import Tolerance
from igtl_gateway.replay.restamp import MODES, Mode

Address = tuple[str, int]
AnyPath = str | PathLike[str]
#: A recording as an argument: its path, or what ``igtl_gateway.open`` returned.
AnyRecording = AnyPath | Recording


def verify(path: AnyRecording, *, config: AnyPath | None = None) -> Verification:
    """Check that the recorded outputs of a session follow from its recorded inputs, with this version.

    Args:
        path: the recording: its path, or an open one.
        config: configuration file (TOML) to use instead of the recorded configuration.

    Returns:
        The result: ``good``, the counts, and each difference with entry, stream, field and both values.

    Raises:
        UnsupportedRecording: the file is not a recording of igtl-gateway, or is an import.
        DamagedRecording: the recording cannot be read to its end.
        ConfigError: the configuration file is invalid.

    Examples:
        >>> verify("fixtures/star.mcap").good
        True
    """
    with session_of(path) as file:
        return verify_session(file, None if config is None else Path(config))


def diff(
    one: AnyRecording,
    other: AnyRecording,
    *,
    streams: str | Sequence[str] = (),
    tolerance_mm: float = 0.0,
    tolerance_deg: float = 0.0,
) -> RecordingDiff:
    """Compare two recordings message by message.

    Args:
        one: a recording, or a rosbag2 MCAP file: its path, or an open one.
        other: the recording to compare with it.
        streams: globs of the streams to compare: topic, ``TYPE/device`` or device; empty: all.
        tolerance_mm: positions up to this distance apart are equal.
        tolerance_deg: rotations up to this angle apart are equal.

    Returns:
        The differences of each stream.

    Raises:
        UnsupportedRecording: a file of another kind.
        DamagedRecording: a recording cannot be read to its end.
        ConfigError: a tolerance is out of range.

    Examples:
        >>> diff("fixtures/star.mcap", "fixtures/star.mcap").equal
        True
    """
    for name, value in (("tolerance_mm", tolerance_mm), ("tolerance_deg", tolerance_deg)):
        if not 0 <= value < float("inf"):
            raise ConfigError(f"{name}: found {value}, expected 0 or more")
    with session_of(one) as first, session_of(other) as second:
        return compare_sessions(first, second, texts("streams", streams), Tolerance(tolerance_mm, tolerance_deg))


def replay_recording(
    path: AnyRecording,
    to: To = "igtl",
    *,
    rate: float | None = 1.0,
    listen: Sequence[Address] = (),
    connect: Sequence[Address] = (),
    streams: str | Sequence[str] = (),
    start: str | float | None = None,
    end: str | float | None = None,
    duration: float | None = None,
    through_gateway: bool = False,
    config: AnyPath | None = None,
    send: str | Sequence[str] = (),
    restamp: Mode = "keep",
    loop: bool = False,
    delay_s: float = 0.0,
    wait_peers: int | None = None,
    clock_hz: float | None = None,
    lock_step: bool = False,
    fault: str = "",
    seed: int = 0,
    allow: str | Sequence[str] = (),
    tls: TlsFiles | None = None,
    digest: bool = True,
    ros_args: Sequence[str] = (),
    stop: threading.Event | None = None,
    on_line: Callable[[str], None] | None = None,
    profile: str = AUTO,
    exact: bool = False,
) -> ReplayResult:
    """Send a recording to OpenIGTLink peers, to ROS, or to both, and wait until it is sent.

    Args:
        path: the recording, or a rosbag2 MCAP file: its path, or an open one, whose file is opened again.
        to: ``"igtl"``, ``"ros"`` or ``"both"``.
        rate: recorded seconds per second; None: without pauses.
        listen: addresses to listen on; without ``listen`` and ``connect``: 127.0.0.1:18944.
        connect: addresses of servers to connect to.
        streams: globs of the streams to send; empty: all.
        start: first recorded time: seconds from the beginning, or a date and time.
        end: last recorded time.
        duration: recorded seconds to send, instead of ``end``.
        through_gateway: recompute the outputs from the recorded inputs with this version.
        config: with ``through_gateway``: configuration file to use instead of the recorded configuration.
        send: ROS topics to send to OpenIGTLink, as ``"/topic=Device:TYPE"``.
        restamp: stamps in the messages: ``"keep"``, ``"now"`` or ``"shift"``.
        loop: repeat until ``stop`` is set.
        delay_s: seconds to wait before the first message.
        wait_peers: number of peers, or of subscribers on each topic, to wait for; None: 1 peer, 0 subscribers.
        clock_hz: rate of the recorded time on /clock; None: do not publish it.
        lock_step: wait after each message until its readers have it.
        fault: faults to inject, such as ``"loss=1%,jitter=20ms"``.
        seed: seed of the fault injection.
        allow: networks (CIDR) whose peers may connect beside those of this host.
        tls: files for TLS at all addresses; None: no TLS.
        digest: compute the SHA-256 of the sent bytes.
        ros_args: arguments of ROS for the node, such as ``["-r", "__ns:=/or1"]``.
        stop: an event; the replay ends when it is set, also while it waits for peers.
        on_line: called with each line of text about what the replay does, from any of its threads.
        profile: profile of all OpenIGTLink peers, such as ``"slicer"``: messages that it cannot read are adapted or
            left out; ``"auto"``: detected from their messages.
        exact: send the recorded bytes, also those at which a peer may lose the stream.

    Returns:
        What was sent, and what was not and why.

    Raises:
        ConfigError: an argument is out of range, or does not fit the recording.
        GatewayError: the recording has no message to send; the replay was stopped before it started.
        Unavailable: a port is in use.
        RosError: ROS is not installed.
    """
    one_of("to", to, get_args(To))
    one_of("restamp", restamp, MODES)
    one_of("profile", profile, PROFILE_NAMES)
    numbers(optional=True, rate=rate, duration=duration, wait_peers=wait_peers, clock_hz=clock_hz)
    numbers(delay_s=delay_s, seed=seed)
    listening, connecting = addresses("listen", listen), addresses("connect", connect)
    if to != "ros" and not (listening or connecting):
        listening = ((HOST, PORT),)
    if to == "ros" and (listening or connecting):
        raise ConfigError("to: found 'ros' with addresses of OpenIGTLink, expected 'igtl' or 'both' with them")
    options = ReplayOptions(
        to,
        listening,
        connecting,
        texts("allow", allow),
        tls or TlsFiles(),
        frozenset(listening if tls else ()),
        frozenset(connecting if tls else ()),
        None if config is None else Path(config),
        texts("send", send),
        None if start is None else str(start),
        None if end is None else str(end),
        duration,
        texts("streams", streams),
        through_gateway,
        restamp,
        None if lock_step else rate,
        lock_step,
        loop,
        False,
        delay_s,
        wait_peers,
        clock_hz,
        fault,
        seed,
        digest,
        ros_arguments(ros_args, ros=to != "igtl", without="to='igtl'"),
        profile,
        exact,
    )
    if isinstance(path, Recording):
        path = path.path
    events = ReplayEvents(on_line=on_line) if on_line else ReplayEvents()
    with of_a_replay():
        result = run_replay(Path(path), options, stop or threading.Event(), events)
    if result is None:
        raise GatewayError(f"{path}: the replay was stopped before it started")
    return result
