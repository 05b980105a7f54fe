"""The services of a recording: ``~/pause_recording``, ``~/resume_recording`` and ``~/snapshot``."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import TimeoutError as NotYetError
from typing import TYPE_CHECKING, Any

from igtl_gateway.edges.interface import RosSide

if TYPE_CHECKING:
    from igtl_gateway.record.recorder import Recorder

TYPE = "std_srvs/srv/Trigger"
PAUSE, RESUME, SNAPSHOT = "~/pause_recording", "~/resume_recording", "~/snapshot"

#: Longest wait for a snapshot, in seconds: enough for half a gigabyte on a slow disk.
_SNAPSHOT_S = 60.0


def serve_recording(ros: RosSide, recorder: Recorder) -> None:
    """Create the services of this recording: ``~/snapshot`` for a snapshot buffer, else pause and resume."""
    if recorder.options.snapshot_s:
        ros.serve(SNAPSHOT, TYPE, lambda _request, response: _answer(response, lambda: snapshot(recorder)))
        return
    ros.serve(PAUSE, TYPE, lambda _request, response: _answer(response, lambda: pause(recorder)))
    ros.serve(RESUME, TYPE, lambda _request, response: _answer(response, lambda: resume(recorder)))


def pause(recorder: Recorder) -> tuple[bool, str]:
    """Pause the recording; return whether that was possible, and a sentence for people."""
    recorder.pause()
    return not recorder.failure, recorder.failure or "the recording is paused"


def resume(recorder: Recorder) -> tuple[bool, str]:
    """Resume the recording; return whether that was possible, and a sentence for people."""
    recorder.resume()
    return not recorder.failure, recorder.failure or "the recording goes on"


def snapshot(recorder: Recorder) -> tuple[bool, str]:
    """Write a snapshot and wait for it; return whether that was possible, and the path or the reason."""
    try:
        return True, str(recorder.snapshot().result(_SNAPSHOT_S))
    except NotYetError:
        return False, f"not written within {_SNAPSHOT_S:g} s"
    except Exception as error:  # for example of the disk: the caller gets the same text as the note
        return False, str(error)


def _answer(response: Any, action: Callable[[], tuple[bool, str]]) -> Any:
    response.success, response.message = action()
    return response
