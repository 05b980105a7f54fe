"""Pictures of a recording without a screen: rerun's own viewer draws them in memory, by software where need be.

The viewer's binary is started and steered over its local connection.  It dies with us: it is stopped at the end of
the ``with`` block, and by the kernel should we be killed.  What it draws arrives in steps (chunks are loaded when
they come into sight), so a picture counts only when two in a row are equal.  What the views of a blueprint complain
of comes with each picture, for people to read and for tests to assert on.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Thread
from typing import Any, Self

from igtl_gateway.errors import ViewerError
from igtl_gateway.extras import missing

TIME_LINE = "gateway_time"
SIZE = (1600, 1000)
START_S = 60.0  #: a slow machine reads a large recording
STEP_S = 0.1
STEPS = 600  #: of ``STEP_S``: how long a recording may take to load
HELLOS = 100  #: questions until the viewer answers the first
GRACE_S = 1.0  #: a viewer that fell silent may be about to end
TRIES = 20  #: pictures until two in a row are equal

#: What the viewer says when there is nothing to draw with: no Vulkan driver, or one that cannot.
_NO_DRIVER = re.compile(r"No graphics adapter|Failed to get render context|Failed to create render context")
#: A viewer without a screen has one font, and ends at a letter that is not in it (egui_kittest's policy).
_NO_LETTER = re.compile(r"No glyph for (\S+ \(U\+[0-9A-F]+\))")
_LISTENS = re.compile(r"Listening for gRPC connections on 127\.0\.0\.1:(\d+)")
_SAID = 20_000  #: characters of the viewer's last words that are kept

#: Everything but the views and the time is taken away from a picture.
_PANELS = {"top_panel": "Hidden", "blueprint_panel": "Hidden", "selection_panel": "Hidden"}


@dataclass(frozen=True, slots=True)
class ViewerComplaint:
    """What a view said against what it was to draw.

    Attributes:
        view: its title.
        severity: ``"warning"`` or ``"error"``.
        text: what is wrong.
    """

    view: str
    severity: str
    text: str

    def __str__(self) -> str:
        return f"{self.view}: {self.severity}: {self.text}"


@dataclass(frozen=True, slots=True)
class Shot:
    """A picture of the viewer's window.

    Attributes:
        time_ns: gateway time that it shows, UTC nanoseconds.
        png: the picture.
        complaints: of all views, in their order; empty is good.
    """

    time_ns: int
    png: bytes
    complaints: tuple[ViewerComplaint, ...]


def take_shots(recording: Path, times_ns: Sequence[int | None], size: tuple[int, int] = SIZE) -> list[Shot]:
    """A picture at each of those gateway times (UTC nanoseconds; None: the end of the recording).

    Raises ViewerError as ``HeadlessViewer`` does.
    """
    with HeadlessViewer(recording, size) as viewer:
        return [viewer.shot(viewer.last_ns if time_ns is None else time_ns) for time_ns in times_ns]


class HeadlessViewer:
    """A viewer without a window that has a recording open.

    Attributes:
        first_ns: the recording's first gateway time, UTC nanoseconds.
        last_ns: its last.
        pid: the viewer's process.

    Raises ViewerError where rerun or a graphics driver is missing, where the viewer does not come up in time or dies,
    and where the recording has no gateway time.
    """

    def __init__(self, recording: Path, size: tuple[int, int] = SIZE) -> None:
        if not recording.is_file():
            raise ViewerError(f"{recording}: no such file; expected a recording of rerun (.rrd)")
        self._process = _start(recording, size)
        self.pid = self._process.pid
        self._words = _Words(self._process)
        try:
            self._client = self._connect()
            self.first_ns, self.last_ns = self._load(recording)
            self._bare()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the viewer; waits until it has gone.  A second call does nothing."""
        end_viewer(self._process)
        self._words.join()

    def at(self, part: float) -> int:
        """The gateway time at that part of the recording, 0 … 1."""
        return self.first_ns + round((self.last_ns - self.first_ns) * part)

    def shot(self, time_ns: int) -> Shot:
        """What the window shows at that gateway time."""
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
        if not self._words.ready.wait(START_S):
            raise ViewerError(f"the viewer was not ready within {START_S:g} s; its last words: {self._words.last()}")
        if self._words.port is None:
            raise self._death()
        from rerun.experimental import ViewerClient

        for _ in range(HELLOS):
            # It says that it listens a moment too early, and answers only when it draws.
            with suppress(RuntimeError, OSError):
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{self._words.port}/proxy")
                client.get_state()
                return client
            if self._words.ended.wait(STEP_S):
                raise self._death()
        raise ViewerError(f"the viewer did not answer; its last words: {self._words.last()}")

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
        raise ViewerError(f"{recording}: found nothing to show after {STEPS * STEP_S:g} s, expected a recording")

    def _bare(self) -> None:
        """Take the panels away; the blueprint stays as it is otherwise."""
        blueprint = self._ask("get_blueprint")
        panels = {f"/{panel}": {"PanelBlueprint": {"state": state}} for panel, state in _PANELS.items()}
        self._ask("set_blueprint", blueprint.blueprint | panels, store_id=blueprint.store_id)

    def _ask(self, what: str, *arguments: Any, **options: Any) -> Any:
        try:
            return getattr(self._client, what)(*arguments, **options)
        except (RuntimeError, OSError, ValueError) as error:
            if self._words.ended.wait(GRACE_S):
                raise self._death() from error
            raise ViewerError(f"the viewer did not do {what}: {error}") from error

    def _death(self) -> ViewerError:
        if _NO_DRIVER.search(self._words.text):
            return ViewerError(
                "found no Vulkan driver that the viewer can draw with; expected that of a graphics card, or one by "
                "software: sudo apt-get install -y --no-install-recommends mesa-vulkan-drivers"
            )
        if letter := _NO_LETTER.search(self._words.text):
            return ViewerError(
                f"found the letter {letter[1]} in a text, which a viewer without a screen has no font for "
                "and ends at; a viewer with a window draws a box"
            )
        return ViewerError(f"the viewer ended by itself; its last words: {self._words.last()}")


class _Words:
    """Reads what the viewer says, so that it never waits for a reader, and keeps what matters of it."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.ready = Event()  #: it listens, or it has ended
        self.ended = Event()
        self.port: int | None = None
        self.text = ""
        self._process = process
        self._thread = Thread(target=self._read, name="viewer's words", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as lines:
            for line in lines:
                self.text = (self.text + line)[-_SAID:]
                if found := _LISTENS.search(line):
                    self.port = int(found[1])
                    self.ready.set()
        self.ended.set()
        self.ready.set()

    def last(self) -> str:
        lines = [line.strip() for line in self.text.splitlines() if line.strip()]
        return " | ".join(lines[-3:]) or "none"

    def join(self) -> None:
        self._thread.join()


def viewer_binary() -> Path:
    """The viewer's own binary: the ``rerun`` on the path is a wrapper in Python that leaves it behind when it ends.

    Raises ViewerError where it is not installed.
    """
    spec = find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        path = Path(spec.origin).with_name("rerun")
        if path.is_file():
            return path
    raise ViewerError(missing("rerun"))


def _start(recording: Path, size: tuple[int, int]) -> subprocess.Popen[str]:
    width, height = size
    arguments = [str(recording), "--headless", "--bind", "127.0.0.1", "--port", "auto"]
    # What it says at other levels it also writes over the picture; where it listens we must hear.
    return start_viewer([*arguments, "--window-size", f"{width}x{height}"], "error,re_grpc_server=info")


def start_viewer(arguments: Sequence[str], log: str) -> subprocess.Popen[str]:
    """The viewer as a process that ends with this one; ``log`` says what it tells on stderr, as RUST_LOG."""
    command = [str(viewer_binary()), *arguments]
    if guard := shutil.which("setpriv"):  # the kernel ends the viewer should this process be killed
        command = [guard, "--pdeathsig", "TERM", "--", *command]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env={**os.environ, "RERUN_ANALYTICS": "0", "NO_COLOR": "1", "RUST_LOG": log},
        start_new_session=True,  # Ctrl-C at the terminal is for us; we end the viewer
    )


def end_viewer(process: subprocess.Popen[str]) -> None:
    """End a viewer, and wait until it has gone."""
    process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _datetime64(time_ns: int) -> Any:
    import numpy as np

    return np.datetime64(time_ns, "ns")
