"""The recording of a bridge, with the upload beside it.

Its services are ``~/start_recording``, ``~/stop_recording``, ``~/pause_recording``, ``~/resume_recording``,
``~/split_recording`` and ``~/snapshot``.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYetError
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.passage import BridgePassage
from igtl_gateway.base.addons import part_of
from igtl_gateway.base.clock import Clock
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert import crtk
from igtl_gateway.convert.igtl_msgs import Command, CommandReply
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.gateway import LINKS_TOPIC
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.gateway.to_igtl.tf_out import TF_QOS
from igtl_gateway.record.selection import StateInputRule

if TYPE_CHECKING:
    from igtl_gateway.record.admission import Admission
    from igtl_gateway.record.recorder import Recorder
    from igtl_gateway.record.reports import RecordingSummary

TYPE = "std_srvs/srv/Trigger"
START, STOP = "~/start_recording", "~/stop_recording"
PAUSE, RESUME, SNAPSHOT = "~/pause_recording", "~/resume_recording", "~/snapshot"
SPLIT = "~/split_recording"

#: Longest wait for a snapshot, in seconds: enough for half a gigabyte on a slow disk; and for the begin or the end of a
#: file, before which what waits is written.
_SNAPSHOT_S, _FILE_S = 60.0, 10.0


class Uploads(Protocol):
    """The upload beside a bridge, of the add-on ``upload``."""

    def counters(self) -> dict[str, Any]:
        """Return what waits, was sent and was confirmed, so far."""
        ...

    def left_text(self) -> str:
        """Return what was uploaded, and what is left and how it is finished."""
        ...

    def stop(self) -> None:
        """Upload what is left, for a limited time."""
        ...


class BridgeRecording:
    """The recorder of a bridge and the upload of its closed files: one part.

    Args:
        path: the file.
        options: of the bridge.
        config: of the session; stored in the recording.
        clock: that of the bridge.
        qos_of: returns the QoS of a recorded topic.
        on_note: takes notes, from any thread.
        losses: returns the loss ledger, which the recording is closed with.
        passage: is recorded, too; None: there is none.
        admission: gets the recorder.

    Attributes:
        recorder, uploads: None before the start.
        summary: of the closed recording; None before the stop.
    """

    def __init__(
        self,
        path: Path,
        options: BridgeOptions,
        config: Config,
        clock: Clock,
        *,
        qos_of: Callable[[str, str], Qos | None],
        on_note: Callable[[Note], None],
        losses: Callable[[], dict[str, Any]],
        passage: BridgePassage | None = None,
        admission: Admission | None = None,
    ) -> None:
        self.recorder: Recorder | None = None
        self.uploads: Uploads | None = None
        self.summary: RecordingSummary | None = None
        self._path = path
        self._options = options
        self._config = config
        self._clock = clock
        self._qos_of = qos_of
        self._on_note = on_note
        self._losses = losses
        self._passage = passage
        self._admission = admission

    def start(self) -> None:
        """Create the file.  Raises RecordingError, and MissingAddon for an upload without its add-on."""
        from igtl_gateway.record.recorder import Recorder  # here: 4 MB that only a recording needs

        self.recorder = Recorder(
            self._path,
            session_facts(self._config, over_zenoh=self._options.zenoh is not None),
            qos_of=self._qos_of,
            on_note=self._on_note,
            clock=self._clock,
            options=self._options.recording,
            rule=state_rule(self._config),
            lock=self._passage.recorder_lock if self._passage else None,
        )
        if self._passage:
            self._passage.record_into(self.recorder)
        if self._admission:
            self._admission.recorder = self.recorder
        if self._options.upload:
            place = part_of("upload", "place:upload_place")(self._options.upload)
            self.uploads = part_of("upload", "live:BridgeUploads")(
                self._path, place, self._options.upload_rate, self._on_note
            )

    def stop(self) -> None:
        """Close the file with the ledger of the session, then upload what is left."""
        if self.recorder:
            self.summary = self.recorder.close(self._losses())
        if self.uploads:
            self.uploads.stop()

    def reserve(self, entry: Entry) -> Callable[[], None] | None:
        """Record an entry; see ``Recorder.reserve``."""
        return self.recorder.reserve(entry) if self.recorder else None

    def discard(self) -> None:
        """Remove the file of a bridge that could not start: an empty one would make the next start fail."""
        if self.summary:
            self.summary.discard()

    @property
    def has_failed(self) -> bool:
        """Whether the recording has failed and the options require the bridge to stop."""
        return bool(self._options.recording.stop_on_failure and self.recorder and self.recorder.failure)


def serve_recording(ros: RosSide, recorder: Recorder) -> None:
    """Create the services of this recording: ``~/snapshot`` for a snapshot buffer, else those of its files."""
    if recorder.options.snapshot_s:
        ros.serve(SNAPSHOT, TYPE, lambda _request, response: _answer(response, lambda: snapshot(recorder)))
        return
    ros.serve(START, TYPE, lambda _request, response: _answer(response, lambda: start(recorder)))
    ros.serve(STOP, TYPE, lambda _request, response: _answer(response, lambda: stop(recorder)))
    ros.serve(PAUSE, TYPE, lambda _request, response: _answer(response, lambda: pause(recorder)))
    ros.serve(RESUME, TYPE, lambda _request, response: _answer(response, lambda: resume(recorder)))
    if recorder.options.has_parts:
        ros.serve(SPLIT, TYPE, lambda _request, response: _answer(response, lambda: split(recorder)))


#: Why nothing can be done with a file.
_RESTS = "the recording is stopped; start it first"


def start(recorder: Recorder) -> tuple[bool, str]:
    """Begin the next file; return whether that was possible, and a sentence for people."""
    if recorder.options.snapshot_s:
        return False, f"the last {recorder.options.snapshot_s:g} s are kept in memory; save them"
    if not recorder.rests:
        return False, recorder.failure or "the recording runs already"
    return _outcome(recorder.start(), "the recording begins: ", _FILE_S)


def stop(recorder: Recorder) -> tuple[bool, str]:
    """Close the file; return whether that was possible, and a sentence for people."""
    if recorder.options.snapshot_s:
        return False, "nothing is written to a file"
    if recorder.rests:
        if recorder.failure:
            recorder.stop()  # the disk is not tried again
        return False, recorder.failure or _RESTS
    return _outcome(recorder.stop(), "the recording is closed: ", _FILE_S)


def pause(recorder: Recorder) -> tuple[bool, str]:
    """Pause the recording; return whether that was possible, and a sentence for people."""
    return _with_file(recorder, recorder.pause, "the recording is paused")


def resume(recorder: Recorder) -> tuple[bool, str]:
    """Resume the recording; return whether that was possible, and a sentence for people."""
    return _with_file(recorder, recorder.resume, "the recording goes on")


def split(recorder: Recorder) -> tuple[bool, str]:
    """Begin the next part with the next input; return whether that is possible, and a sentence for people."""
    if not recorder.options.has_parts:
        return False, "the recording has one file; start it with --split-size or --split-duration"
    return _with_file(recorder, recorder.split, "the next message begins a new file")


def _with_file(recorder: Recorder, action: Callable[[], object], done: str) -> tuple[bool, str]:
    """Do something with the file; return whether there is one, and a sentence for people."""
    if recorder.rests:
        return False, recorder.failure or _RESTS
    action()
    return not recorder.failure, recorder.failure or done


def snapshot(recorder: Recorder) -> tuple[bool, str]:
    """Write a snapshot and wait for it; return whether that was possible, and the path or the reason."""
    return _outcome(recorder.snapshot(), "", _SNAPSHOT_S)


def _outcome(done: Future[Path], words: str, timeout_s: float) -> tuple[bool, str]:
    """Wait for a request; return whether it was possible, and its path or the reason."""
    try:
        return True, f"{words}{done.result(timeout_s)}"
    except NotYetError:
        return False, f"the disk has not answered within {timeout_s:g} s; a note reports the outcome"
    except Exception as error:  # for example of the disk: the caller gets the same text as the note
        return False, str(error)


#: What can be done with a recording, for people who press it.
ACTIONS: dict[str, Callable[[Recorder], tuple[bool, str]]] = {
    "start": start, "stop": stop, "pause": pause, "resume": resume, "snapshot": snapshot, "split": split,
}  # fmt: skip


def _answer(response: Any, action: Callable[[], tuple[bool, str]]) -> Any:
    response.success, response.message = action()
    return response


def state_rule(config: Config) -> StateInputRule:
    """Return which inputs a recording needs of streams that are left out; see ``record.selection``."""
    commands = frozenset({"COMMAND", "RTS_COMMAND", Command.TYPE, CommandReply.TYPE})
    mixed = frozenset(TF_QOS) if config.tf_out else frozenset()
    robots: list[str] = []
    arms = [f"{row.arms}{below}" for row in config.all_arms for below in ("", "/**")]
    if arms and config.allow_in:
        robots += (f"{arm}/{state}" for arm in arms for state in ("measured_cp", "measured_js"))
        robots += (f"/{glob}" for glob in config.allow_in)
    stamped = tuple(f"{arm}/{row.name}" for arm in arms for row in crtk.NAMES)
    aged = config.max_age_s > 0 or any(row.max_age_s for row in config.to_igtl)
    return StateInputRule(frozenset({LINKS_TOPIC}), commands, mixed, tuple(robots), stamped, aged)


def session_facts(config: Config, *, over_zenoh: bool = False) -> dict[str, str]:
    """Return the metadata of a recording: configuration, versions, host."""
    rmw = "rmw_zenoh_cpp" if over_zenoh else os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    packages = ("mcap", "numpy", "rosbags", "fastcrc", "eclipse-zenoh" if over_zenoh else "ros-jazzy-rclpy")
    return {
        "igtl_gateway_version": __version__,
        "config": json.dumps(config.to_dict(), sort_keys=True),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "host": platform.node(),
        "packages": json.dumps(_versions(packages), sort_keys=True),
        "ros_domain_id": os.environ.get("ROS_DOMAIN_ID", "0"),
        "rmw_implementation": rmw,
        "command": " ".join(sys.argv),
    }


def _versions(packages: Sequence[str]) -> dict[str, str]:
    from importlib import metadata  # here: a bridge that records nothing does not need it

    found = {}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
