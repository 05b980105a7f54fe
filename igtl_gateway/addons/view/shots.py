"""Screenshots of a recording without a screen: rerun's viewer renders in memory, in software if necessary.

The viewer runs as a child process and is controlled over its local connection.  It never outlives this process: the
``with`` block stops it at its end, and the kernel stops it if this process is killed.  The viewer draws in steps, as
chunks are loaded, so a screenshot is valid only when two in a row are equal.  Each screenshot has the errors and
warnings of the views, for people to read and for tests to assert on.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

from igtl_gateway.addon import Self, ViewerError
from igtl_gateway.addons.view.process import ViewerProcess

TIME_LINE = "gateway_time"
SIZE = (1600, 1000)
START_S = 60.0  #: a slow machine needs long to read a large recording
STEP_S = 0.1
STEPS = 600  #: steps of ``STEP_S``: timeout for loading a recording
HELLOS = 100  #: requests until the viewer must have answered the first
GRACE_S = 1.0  #: a viewer that does not answer may be about to exit
TRIES = 20  #: screenshots until two in a row are equal

_NEEDS_DRIVER = (
    "found no usable Vulkan driver, expected that of a graphics card, or a software driver: "
    "sudo apt-get install -y --no-install-recommends mesa-vulkan-drivers"
)
#: What the viewer logs without a usable Vulkan driver.
_NO_DRIVER = re.compile(r"No graphics adapter|Failed to get render context|Failed to create render context")
#: A headless viewer has one font and exits at a character that is not in it (policy of egui_kittest).
_NO_LETTER = re.compile(r"No glyph for (\S+ \(U\+[0-9A-F]+\))")
_LISTENS = re.compile(r"Listening for gRPC connections on 127\.0\.0\.1:([0-9]+)")

#: A screenshot shows the views and the time, no other panels.
_PANELS = {"top_panel": "Hidden", "blueprint_panel": "Hidden", "selection_panel": "Hidden"}


@dataclass(frozen=True, slots=True)
class ViewerComplaint:
    """An error or a warning that a view reports.

    Attributes:
        view: title of the view.
        severity: ``"warning"`` or ``"error"``.
        text: the message of the viewer.
    """

    view: str
    severity: str
    text: str

    def __str__(self) -> str:
        return f"{self.view}: {self.severity}: {self.text}"


@dataclass(frozen=True, slots=True)
class Shot:
    """A screenshot of the viewer's window.

    Attributes:
        time_ns: gateway time of the screenshot, UTC nanoseconds.
        png: the image, encoded as PNG.
        complaints: errors and warnings of all views, in the order of the views.
    """

    time_ns: int
    png: bytes
    complaints: tuple[ViewerComplaint, ...]


def check_driver(environment: Mapping[str, str]) -> None:
    """Raise ViewerError if no Vulkan driver is installed: a user should not wait for the drawing first.

    Only Linux is checked.  The places are those in which the loader of Vulkan looks for the manifests of drivers
    (LoaderDriverInterface.md of Khronos).
    """
    if sys.platform != "linux":
        return
    if named := environment.get("VK_DRIVER_FILES") or environment.get("VK_ICD_FILENAMES"):
        found = any(Path(path).is_file() for path in named.split(":"))
    else:
        home = environment.get("HOME", "")
        places = [
            environment.get("XDG_CONFIG_HOME") or f"{home}/.config",
            *(environment.get("XDG_CONFIG_DIRS") or "/etc/xdg").split(":"),
            "/etc",
            "/usr/local/etc",
            environment.get("XDG_DATA_HOME") or f"{home}/.local/share",
            *(environment.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share").split(":"),
        ]
        found = any(True for place in places for _ in Path(place, "vulkan", "icd.d").glob("*.json"))
    if not found:
        raise ViewerError(_NEEDS_DRIVER)


def take_shots(recording: Path, times_ns: Sequence[int | None], size: tuple[int, int] = SIZE) -> list[Shot]:
    """Take a screenshot at each gateway time (UTC nanoseconds; None: the end of the recording).

    Raises ViewerError as ``HeadlessViewer`` does.
    """
    with HeadlessViewer(recording, size) as viewer:
        return [viewer.shot(viewer.last_ns if time_ns is None else time_ns) for time_ns in times_ns]


class HeadlessViewer:
    """A headless viewer with an open recording.

    Attributes:
        first_ns: first gateway time of the recording, UTC nanoseconds.
        last_ns: last gateway time of the recording, UTC nanoseconds.
        pid: process id of the viewer.

    Raises ViewerError if rerun or a graphics driver is missing, if the viewer does not start in time or exits, and if
    the recording has no gateway time.
    """

    def __init__(self, recording: Path, size: tuple[int, int] = SIZE) -> None:
        if not recording.is_file():
            raise ViewerError(f"{recording}: no such file, expected a rerun recording (.rrd)")
        self._process = _start(recording, size)
        self.pid = self._process.pid
        try:
            self._client = self._connect()
            self.first_ns, self.last_ns = self._load(recording)
            self._hide_panels()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the viewer and wait until it has exited.  A second call does nothing."""
        self._process.close()

    def at(self, part: float) -> int:
        """Return the gateway time at a fraction 0 … 1 of the recording."""
        return self.first_ns + round((self.last_ns - self.first_ns) * part)

    def shot(self, time_ns: int) -> Shot:
        """Take a screenshot at a gateway time."""
        self._ask("set_time", TIME_LINE, timestamp=_datetime64(time_ns), play_state="paused")
        png = b""
        for _ in range(TRIES):
            before, png = png, self._ask("take_screenshot")
            if png == before:
                break
        views = self._ask("get_state").views
        complaints = [
            ViewerComplaint(view.name or view.origin, report.severity, report.summary)
            for view in views
            for report in view.reports
        ]
        return Shot(time_ns, png, tuple(complaints))

    def _connect(self) -> Any:
        if not self._process.ready.wait(START_S):
            raise ViewerError(
                f"the viewer was not ready in {START_S:g} s; its last log lines: {self._process.last_lines()}"
            )
        if not self._process.found[0]:
            raise self._exit_error()
        from rerun.experimental import ViewerClient

        for _ in range(HELLOS):
            # the viewer reports that it listens slightly too early, and answers only when it draws
            with suppress(RuntimeError, OSError):
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{self._process.found[0]}/proxy")
                client.get_state()
                return client
            if self._process.ended.wait(STEP_S):
                raise self._exit_error()
        raise ViewerError(f"the viewer did not answer; its last log lines: {self._process.last_lines()}")

    def _load(self, recording: Path) -> tuple[int, int]:
        step = Event()
        for _ in range(STEPS):
            state = self._ask("get_state")
            lines = [line for one in state.recordings for line in one.timelines if line.end is not None]
            if lines and not state.loading:
                for line in lines:
                    if line.name == TIME_LINE:
                        return line.start, line.end
                found = ", ".join(line.name for line in lines)
                raise ViewerError(f"{recording}: found the time lines {found}, expected one named {TIME_LINE}")
            step.wait(STEP_S)
        raise ViewerError(f"{recording}: found no data after {STEPS * STEP_S:g} s, expected a recording")

    def _hide_panels(self) -> None:
        """Hide the panels; the rest of the blueprint stays."""
        blueprint = self._ask("get_blueprint")
        panels = {f"/{panel}": {"PanelBlueprint": {"state": state}} for panel, state in _PANELS.items()}
        self._ask("set_blueprint", blueprint.blueprint | panels, store_id=blueprint.store_id)

    def _ask(self, what: str, *arguments: Any, **options: Any) -> Any:
        try:
            return getattr(self._client, what)(*arguments, **options)
        except (RuntimeError, OSError, ValueError) as error:
            if self._process.ended.wait(GRACE_S):
                raise self._exit_error() from error
            raise ViewerError(f"the viewer did not do {what}: {error}") from error

    def _exit_error(self) -> ViewerError:
        if _NO_DRIVER.search(self._process.text):
            return ViewerError(_NEEDS_DRIVER)
        if letter := _NO_LETTER.search(self._process.text):
            return ViewerError(
                f"found the character {letter[1]} in the session: a headless viewer has no font for it and exits; "
                "a viewer with a window draws a box"
            )
        return ViewerError(f"the viewer exited unexpectedly; its last log lines: {self._process.last_lines()}")


def _start(recording: Path, size: tuple[int, int]) -> ViewerProcess:
    width, height = size
    arguments = [str(recording), "--headless", "--bind", "127.0.0.1", "--port", "auto"]
    # messages of other levels also appear in the screenshot; the port is needed
    log = "error,re_grpc_server=info"
    return ViewerProcess([*arguments, "--window-size", f"{width}x{height}"], log, [_LISTENS])


def _datetime64(time_ns: int) -> Any:
    import numpy as np

    return np.datetime64(time_ns, "ns")
