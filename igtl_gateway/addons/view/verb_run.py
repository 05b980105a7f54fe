"""``igtl-gateway view``: a session in rerun: in its window, as a file, as a page, as a picture."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from igtl_gateway.addon import (
    NS_PER_S,
    ConfigError,
    DamagedRecording,
    GatewayError,
    SystemClock,
    ViewerError,
    did_you_mean,
    near_names,
    one_of,
)
from igtl_gateway.addon.processes import is_present, is_program, missing, part_of
from igtl_gateway.addon.reading import (
    Entry,
    EntryColumns,
    Kind,
    RecordedStamps,
    SessionFile,
    Unfit,
    config_to_run,
    in_larger_blocks,
    marked_moment,
    marks_of,
    without_messages,
)
from igtl_gateway.addon.ros import PointCloud2
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.terminal import (
    aligned,
    clear_live_line,
    count_text,
    duration_text,
    is_terminal,
    live_line,
    moment_text,
    natural,
    print_json,
    print_line,
    size_text,
    stop_event,
)
from igtl_gateway.addon.untrusted import cpu_time
from igtl_gateway.addon.writing import check_target, write_bytes, write_error, written

if TYPE_CHECKING:
    from igtl_gateway.addons.review import Material
    from igtl_gateway.addons.view.session import SessionView
    from igtl_gateway.addons.view.shots import Shot

_PROGRESS_EVERY = 1000
_BLOCK_ENTRIES, _BLOCK_BYTES = 16_384, 2 << 20  #: of what is drawn at once
_WAIT_S = 0.2


def run(options: argparse.Namespace) -> int:
    is_image = options.output and (options.output.suffix == ".png" or options.output_spelling == "--screenshot")
    options.screenshot, options.save = (options.output, None) if is_image else (None, options.output)
    _check(options)
    files = [options.file, *filter(None, [options.other])]
    for path in files:
        with SessionFile.open(path) as file:  # before what only a good file needs: rerun, a screen
            if not file.entry_count:
                raise without_messages(file)
            options.at_ns = None if options.at is None else _moment_ns(file, options.at)
    if find_spec("rerun") is None:
        raise ViewerError(missing("rerun"))
    if not (options.screenshot or options.save or options.web):
        from igtl_gateway.addons.view.viewer import check_screen  # here: a file needs no viewer

        check_screen(os.environ)  # before the work, not after it
    if is_program():
        from igtl_gateway.addons.view.arrays import leave_out_pandas  # here: it imports rerun

        leave_out_pandas()
    with stop_event() as stop, _folder() as folder:
        outs = [options.save or folder / f"session{number}.rrd" for number in range(len(files))]
        with (
            written(options.screenshot, overwrite=options.overwrite) if options.screenshot else nullcontext() as picture
        ):
            if picture:
                from igtl_gateway.addons.view.shots import check_driver  # here: a file needs no picture

                check_driver(os.environ)
            drawn = [
                _drawn(options, path, number, out, stop.is_set)
                for number, (path, out) in enumerate(zip(files, outs, strict=True))
            ]
            shot = _picture(options, outs[0], picture, drawn[0][0]) if picture else None
        for path, (view, facts) in zip(files, drawn, strict=True):  # who reads may leave: the file is there
            _report(options, path, view, facts)
        found = [facts for _, facts in drawn]
        if options.json:
            print_json(found[0] | ({"other": found[1]} if options.other else {}))
        if shot:
            _report_picture(options, shot)
        elif not options.save:
            _show(options, outs, stop.wait)
    nothing = any(facts["refused"] and not facts["drawn"] for facts in found)
    return int(nothing or any(facts["damage"] for facts in found) or bool(shot and shot.complaints))


def _drawn(
    options: argparse.Namespace, path: Path, number: int, out: Path, stopped: Any
) -> tuple[SessionView, dict[str, Any]]:
    """Draw one of the sessions; return it with the facts."""
    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    with written(out, overwrite=options.overwrite) as partial:
        view, facts = _draw(options, path, number, partial, stopped)
        if options.save and stopped():
            raise KeyboardInterrupt  # a part of the session is not the file that was asked for
    facts["seconds"] = round((clock.monotonic_ns() - started_ns) / NS_PER_S, 3)
    facts["bytes"] = out.stat().st_size
    return view, facts


def _report(options: argparse.Namespace, path: Path, view: SessionView, facts: dict[str, Any]) -> None:
    """Print what was drawn of a session, and where it is damaged."""
    if not options.json:
        _print(options, path, view, facts)
    if facts["damage"]:
        print_line(f"igtl-gateway view: only the messages before the damage are drawn: {facts['damage']}", error=True)


@contextmanager
def _folder() -> Iterator[Path]:
    """A temporary folder, which is deleted at the end."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="igtl-view-", ignore_cleanup_errors=True)
    except OSError as error:
        raise GatewayError(f"found no directory for temporary files; set TMPDIR: {error}") from None
    with folder as name:
        yield Path(name)


def _check(options: argparse.Namespace) -> None:
    if options.at is not None and not options.screenshot:
        raise ConfigError("--at: found no -o OUT.png, expected it: --at is the time of the image")
    if options.port is not None and not options.web:
        raise ConfigError("--port: found no --web, expected it: --port is the port of the web page")
    if options.overwrite and not (options.save or options.screenshot):
        raise ConfigError("--overwrite: found no -o OUT, expected it")
    if options.port is not None and not 0 <= options.port < 1 << 16:
        raise ConfigError(f"--port: found {options.port}, expected 0 to 65535")
    if options.other and options.output:
        raise ConfigError(f"-o: found two recordings, {options.file} and {options.other}, expected one of them")
    for path in filter(None, (options.save, options.screenshot)):
        check_target(path, overwrite=options.overwrite)


def _moment_ns(file: SessionFile, text: str) -> int:
    """Return UTC ns of the image.  Raises ConfigError."""
    at_ns = marked_moment(text, file.start_ns, "--at", lambda: marks_of(file))
    if not file.start_ns <= at_ns <= file.end_ns:
        raise ConfigError(
            f"--at: found {text}, expected at most {moment_text(file.end_ns - file.start_ns)}, the end of the recording"
        )
    return at_ns


def _robot(word: str) -> tuple[str, Path]:
    """Return the namespace and the file of a robot."""
    namespace, separator, name = word.partition("=")
    if not separator or Path(word).exists():
        return "", Path(word)
    return f"/{namespace.strip('/')}" if namespace.strip("/") else "", Path(name)


def _draw(
    options: argparse.Namespace, path: Path, number: int, out: Path, stopped: Any
) -> tuple[SessionView, dict[str, Any]]:
    """The session in ``path`` as a recording of rerun in ``out``; ``number`` sets apart what has the same name."""
    from igtl_gateway.addons.view import stream
    from igtl_gateway.addons.view.blueprints import NAMES
    from igtl_gateway.addons.view.canvas import Options
    from igtl_gateway.addons.view.pen import valid
    from igtl_gateway.addons.view.session import SessionView

    if options.blueprint and options.blueprint not in NAMES:
        raise ConfigError(f"--blueprint: found {options.blueprint!r}, expected {one_of(options.blueprint, NAMES)}")
    with SessionFile.open(path) as file:
        config = config_to_run(file.session)
        again = f"-{number + 1}" if number else ""
        name, application = f"{path.stem}-{file.start_ns}{again}", stream.APPLICATION + again
        recording = stream.to_file(out, valid(name), application)
        view = SessionView(
            recording, config.base_frame, Options(colour_by=options.colour_by, plain=bool(options.screenshot))
        )
        measured = _lag(options, path, view)
        if options.plot:
            _plot(options, path, view)
        for word in options.urdf:
            namespace, urdf = _robot(word)
            view.add_robot(urdf, namespace)
        material = None if options.no_review else _material(file)
        reported = file.merge.reported if file.merge else []
        damage = _draw_entries(file, config, view, material, stopped)
        if not damage:
            view.marks(mark for mark in marks_of(file) if mark.is_added or file.merge)
        if material:
            _review(material, view)
        view.finish()
    layout = stream.arrange(recording, options.blueprint, view.seen)
    try:
        stream.close(recording, out)
    except OSError as error:
        raise write_error(options.save or out, error) from None
    facts = view.counts
    return view, {
        "file": str(path),
        "out": str(options.save or options.screenshot or ""),
        "blueprint": layout,
        "reviewed": view.seen.reviewed,
        "lag": measured,
        "plots": view.seen.chosen,
        "seconds_of_session": view.seen.seconds,
        "messages": sum(facts.messages.values()),
        "drawn": facts.drawn,
        "topics": [
            {"topic": shown.topic, "type": shown.ros_type, "picture": shown.what.value, "messages": shown.count}
            for shown in sorted(view.seen.shown.values(), key=lambda each: (each.topic, each.ros_type))
        ],
        "without_picture": dict(sorted(facts.without_picture.items())),
        "refused": dict(sorted(facts.refused.items())),
        "damage": damage,
        "without_time": dict(sorted(facts.timeless.items())),
        "clocks": view.clocks(),
        "reported": [f"reported by {each}" for each in reported],
        "without_joints": [
            namespace
            for namespace, _ in map(_robot, options.urdf)
            if namespace and not any(f"{topic}/".startswith(f"/{namespace.strip('/')}/") for topic in view.seen.shown)
        ],
        "without_field": bool(options.colour_by) and options.colour_by not in view.seen.fields,
    }


def _plot(options: argparse.Namespace, path: Path, view: SessionView) -> None:
    """Draw the fields that ``--plot`` names."""
    from igtl_gateway.addon.reading import open_recording  # here: most views are of entries only
    from igtl_gateway.addons.view.chosen import series_of

    with open_recording(path) as recording:
        for word in options.plot:
            view.plot(series_of(recording, word))


def _lag(options: argparse.Namespace, path: Path, view: SessionView) -> dict[str, Any] | None:
    """Draw the lag between two streams, and return it for JSON."""
    if not options.sync:
        return None
    from igtl_gateway.addon.reading import open_recording  # here: most views are of entries only
    from igtl_gateway.addons.sync.curves import lag_text  # here: view works without this add-on
    from igtl_gateway.addons.sync.lag import measure_lag
    from igtl_gateway.addons.sync.lags import movement
    from igtl_gateway.addons.sync.verb_run import lag_facts, stream_named

    with open_recording(path) as recording:
        fixed, moving = (stream_named([recording], name) for name in options.sync)
        signals = movement(fixed), movement(moving)
        is_stamped = len(fixed) and bool(np.all(fixed.stamps))
        shift_ns = int(np.median(fixed.times - fixed.stamps)) if is_stamped else 0
    lag = measure_lag(*signals)
    view.lag(*signals, lag, shift_ns)
    return lag_facts(signals[1], lag) | {"fixed": signals[0].name, "text": lag_text(lag)}


def _draw_entries(file: SessionFile, config: Config, view: SessionView, material: Material | None, stopped: Any) -> str:
    """Draw all entries up to the first that cannot be read; why it cannot, or ""."""
    progress = _Progress(file.entry_count)
    try:
        for entries in _entries(file, config):
            if stopped():
                raise KeyboardInterrupt
            if isinstance(entries, Entry):
                view.take(entries)
                if material:
                    material.take(entries)
            else:
                view.take_columns(entries)
                if material:
                    for entry in entries.where(entries.of(material.reads)).entries():
                        material.take(entry)
            progress.step(1 if isinstance(entries, Entry) else len(entries))
    except DamagedRecording as error:
        view.end(str(error))
        return str(error)
    finally:
        progress.end()
    return ""


def _entries(file: SessionFile, config: Config) -> Iterator[Entry | EntryColumns]:
    """The entries to draw, many at once where they are drawn as they are in the file.

    If OpenIGTLink messages were not converted (the recording of a relay, an imported one), this version converts them.
    """
    if file.prologue_file() is not None:
        from igtl_gateway.addon.reading import latched_before  # here: few files are later parts

        # what was latched before a part is there from its first moment on
        for entry in latched_before(file, config):
            yield replace(entry, stamp_ns=file.start_ns)
    stamps = RecordedStamps(file)
    if _is_converted(file):
        if not stamps:
            with suppress(Unfit):
                yield from in_larger_blocks(file.columns(), _BLOCK_ENTRIES, _BLOCK_BYTES)
                return
        yield from (stamps.entry(entry) for entry in file.entries())
        return
    from igtl_gateway.addon.reading import through_gateway  # here: most recordings are converted

    has_links = any(channel.count and channel.kind is Kind.LINK for channel in file.channels)
    converted = through_gateway(file.entries(), replace(config, relay=False), has_links=has_links)
    for number, entry in enumerate(converted, 1):
        yield replace(entry, seq=number)


def _is_converted(file: SessionFile) -> bool:
    """Whether the recording has the ROS messages that OpenIGTLink messages became."""
    kinds = {channel.kind for channel in file.channels if channel.count}
    return Kind.IGTL_IN not in kinds or Kind.ROS_OUT in kinds


def _material(file: SessionFile) -> Material | None:
    """What a review is made of; None where there can be no review: it needs clouds."""
    has_clouds = any(channel.count and channel.type == PointCloud2.TYPE for channel in file.channels)
    may_have = has_clouds or not _is_converted(file) or file.prologue_file() is not None
    if not may_have or not is_present("review"):
        return None
    material: Material = part_of("review", "material:Material")()
    return material


def _review(material: Material, view: SessionView) -> None:
    """Judge the plan, where the session has one and what it takes."""
    from igtl_gateway.addons.review import review_of

    try:
        review = review_of(material)
    except GatewayError:
        return
    view.review(review)


class _Progress:
    """One live line, on a terminal only."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._done = 0
        self._shown = is_terminal(error=True)

    def step(self, entries: int) -> None:
        before = self._done // _PROGRESS_EVERY
        self._done += entries
        if self._shown and self._done // _PROGRESS_EVERY > before:
            live_line(f"drawing {min(self._done / max(self._total, 1), 1.0):4.0%}", error=True)

    def end(self) -> None:
        if self._shown:
            clear_live_line(error=True)


def _print(options: argparse.Namespace, path: Path, view: SessionView, facts: dict[str, Any]) -> None:
    rows: list[Sequence[str]] = [("topic", "messages", "shown as")]
    for shown in sorted(view.seen.shown.values(), key=lambda each: natural(each.topic)):
        note = "not drawn" if shown.ros_type in view.counts.without_picture else shown.what.value
        rows.append((shown.topic, f"{shown.count:,}", f"{note}, {shown.ros_type}"))
    if len(rows) > 1:
        print_line(*aligned(rows, text=True))
    for topic, number in facts["refused"].items():
        print_line(f"? {topic}: {count_text(number, 'message')} cannot be drawn, the log has the reason")
    for line, number in facts["without_time"].items():
        print_line(
            f"? {count_text(number, 'entry', 'entries')} not on the time line {line}: stamps before 1970 or after 2116"
        )
    for text in (*facts["clocks"], *facts["reported"]):
        print_line(f"? {text}")
    for namespace in facts["without_joints"]:
        joints = {topic.rpartition("/")[0] for topic, shown in view.seen.shown.items() if "Joint" in shown.ros_type}
        question = did_you_mean(near_names(namespace, sorted(joints)))
        print_line(
            f"? --urdf {namespace}: found no topic below it: nothing moves the robot{question and f'; {question}'}"
        )
    if facts["without_field"]:
        expected = f"expected {one_of(options.colour_by, sorted(view.seen.fields))}"
        print_line(f"? --colour-by: found no cloud with a field {options.colour_by!r}, {expected}")
    all_of_them = count_text(facts["messages"], "message")
    drawn = all_of_them if facts["drawn"] == facts["messages"] else f"{facts['drawn']:,} of {all_of_them}"
    print_line(
        f"{path}: {drawn} drawn in {duration_text(facts['seconds'] * NS_PER_S)}, "
        f"blueprint {facts['blueprint']}" + (", suture plan reviewed" if facts["reviewed"] else "")
    )
    if lag := facts["lag"]:
        print_line(f"{lag['stream']} behind {lag['fixed']}: {lag['text']}")
    if options.save:
        print_line(f"{options.save}: {size_text(facts['bytes'])}; `rerun {options.save}` shows it")


def _picture(options: argparse.Namespace, recording: Path, out: Path, view: SessionView) -> Shot:
    """Write the picture to the file ``out``."""
    from igtl_gateway.addons.view.shots import take_shots

    if not view.seen.first_ns:
        raise GatewayError(f"{options.file}: found no messages, expected at least one")
    at_ns = options.at_ns
    if at_ns is not None:
        at_ns = min(max(at_ns, view.seen.first_ns), view.seen.first_ns + round(view.seen.seconds * NS_PER_S))
    (shot,) = take_shots(recording, [at_ns])
    try:
        write_bytes(out, shot.png)
    except OSError as error:
        raise write_error(options.screenshot, error) from None
    return shot


def _report_picture(options: argparse.Namespace, shot: Shot) -> None:
    for complaint in shot.complaints:
        print_line(f"? {complaint}", error=True)
    if not options.json:
        print_line(f"{options.screenshot}: {size_text(len(shot.png))}")


def _show(options: argparse.Namespace, sessions: list[Path], wait: Any) -> None:
    """The window or the page, until it is closed or Ctrl-C comes."""
    from igtl_gateway.addons.view.viewer import Viewer

    viewing = Viewer.page(sessions, options.port or 0) if options.web else Viewer.window(sessions)
    with cpu_time.not_counted(), viewing as viewer:
        if options.web:
            print_line(viewer.url, "Press Ctrl-C to stop.", flush=True)
        while not viewer.ended and not wait(_WAIT_S):
            pass
