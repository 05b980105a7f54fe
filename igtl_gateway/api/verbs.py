"""The verbs of the command line as functions: ``replay_recording``, ``verify``, ``diff``.

Each calls the function that its verb calls.  Nothing prints; a failure is an exception of `igtl_gateway.base.errors`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from igtl_gateway.api.keywords import of_a_replay, replay_values, ros_arguments, texts, with_keywords
from igtl_gateway.api.recording import Recording, session_of
from igtl_gateway.app.comparison import RecordingDiff, compare_sessions
from igtl_gateway.app.replay_options import ReplayOptions
from igtl_gateway.app.replay_settings import REPLAY, To
from igtl_gateway.app.replaying import ReplayEvents, ReplayResult, run_replay
from igtl_gateway.app.verification import Verification, verify_session
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.edges.tcp import TlsFiles
from igtl_gateway.replay.compare import Tolerance

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


@with_keywords(REPLAY)
def replay_recording(
    path: AnyRecording,
    to: To = "igtl",
    *,
    tls: TlsFiles | None = None,
    ros_args: Sequence[str] = (),
    stop: threading.Event | None = None,
    on_line: Callable[[str], None] | None = None,
    **settings: Any,
) -> ReplayResult:
    """Send a recording to OpenIGTLink peers, to ROS, or to both, and wait until it is sent.

    Args:
        path: the recording, or a rosbag2 MCAP file: its path, or an open one, whose file is opened again.
        to: ``"igtl"``, ``"ros"`` or ``"both"``.
        tls: files for TLS at all addresses; None: no TLS.
        ros_args: arguments of ROS for the node, such as ``["-r", "__ns:=/or1"]``.
        stop: an event; the replay ends when it is set, also while it waits for peers.
        on_line: called with each line of text about what the replay does, from any of its threads.
        settings: name → value, the options of ``igtl-gateway replay``; ``help`` lists the names and defaults, and
            ``docs/how-to/python.md`` what they do.  Addresses (``listen``, ``connect``) are pairs of host and
            port, and ``rate=None`` is without pauses.

    Returns:
        What was sent, and what was not and why.

    Raises:
        ConfigError: an argument is unknown or out of range, or does not fit the recording.
        GatewayError: the recording has no message to send; the replay was stopped before it started.
        Unavailable: a port is in use.
        RosError: ROS is not installed.
    """
    with of_a_replay():
        values = replay_values(to, tls, settings)
        arguments = ros_arguments(ros_args, ros=to != "igtl", without="to='igtl'")
        options = ReplayOptions.of(values, arguments)
        if isinstance(path, Recording):
            path = path.path
        events = ReplayEvents(on_line=on_line) if on_line else ReplayEvents()
        result = run_replay(Path(path), options, stop or threading.Event(), events)
    if result is None:
        raise GatewayError(f"{path}: the replay was stopped before it started")
    return result
