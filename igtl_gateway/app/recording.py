"""The services of a recording: ``~/pause_recording``, ``~/resume_recording`` and ``~/snapshot``."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import TimeoutError as NotYetError
from typing import Any

from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.record.recorder import Recorder

TYPE = "std_srvs/srv/Trigger"
PAUSE, RESUME, SNAPSHOT = "~/pause_recording", "~/resume_recording", "~/snapshot"

#: Longest time in which a snapshot is written: half a gigabyte to a slow disk.
_SNAPSHOT_S = 60.0


def serve_recording(ros: RosEdge, recorder: Recorder) -> None:
    """Offer those that make sense for this recording."""
    if recorder.options.snapshot_s:
        ros.serve(SNAPSHOT, TYPE, lambda _request, response: _answer(response, lambda: snapshot(recorder)))
        return
    ros.serve(PAUSE, TYPE, lambda _request, response: _answer(response, lambda: pause(recorder)))
    ros.serve(RESUME, TYPE, lambda _request, response: _answer(response, lambda: resume(recorder)))


def pause(recorder: Recorder) -> tuple[bool, str]:
    """Pause; whether that was possible, and a sentence."""
    recorder.pause()
    return not recorder.failure, recorder.failure or "the recording is paused"


def resume(recorder: Recorder) -> tuple[bool, str]:
    """Go on; whether that was possible, and a sentence."""
    recorder.resume()
    return not recorder.failure, recorder.failure or "the recording goes on"


def snapshot(recorder: Recorder) -> tuple[bool, str]:
    """Write a snapshot and wait for it; whether that was possible, and its path or the reason."""
    try:
        return True, str(recorder.snapshot().result(_SNAPSHOT_S))
    except NotYetError:
        return False, f"not written within {_SNAPSHOT_S:g} s"
    except Exception as error:  # of the disk: the caller is told, as the note tells everybody
        return False, str(error)


def _answer(response: Any, action: Callable[[], tuple[bool, str]]) -> Any:
    response.success, response.message = action()
    return response
