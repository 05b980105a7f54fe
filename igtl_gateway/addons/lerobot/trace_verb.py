"""``igtl-gateway export --to lerobot --trace``: the messages behind a frame, and their bytes."""

from __future__ import annotations

import argparse
import re
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.terminal import count_text, print_json, print_line
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addons.lerobot.options import LEROBOT

if TYPE_CHECKING:
    from igtl_gateway.addon.reading import MessagePlace
    from igtl_gateway.addons.lerobot.tracing import TracedRow

#: Options that need --trace.
OF_TRACE = {"frame": "--frame", "feature": "--feature"}
#: Number of a frame in the set, or in an episode.
_FRAME = re.compile(r"(?:([0-9]{1,9}):)?([0-9]{1,9})")


def run_trace(options: argparse.Namespace) -> int:
    """Print the messages behind a frame; return the exit code."""
    from igtl_gateway.addons.lerobot.tracing import trace

    found = _FRAME.fullmatch(options.frame or "")
    if not found:
        raise ConfigError(
            f"--frame: found {options.frame or 'none'}, expected a number such as 17, or of an episode such as 2:17"
        )
    episode = None if found[1] is None else int(found[1])
    traced = trace(options.trace, episode, int(found[2]), options.feature or "", options.files)
    session = traced.session
    if options.json:
        rows = [
            {**asdict(row), "messages": [{**asdict(each), "place": _place(each.place)} for each in row.messages]}
            for row in traced.rows
        ]
        facts = {"name": session.name, "sha256": session.sha256, "split": session.split}
        numbers = {"frame": traced.index, "episode": traced.episode, "frame_index": traced.frame}
        print_json(
            {"to": LEROBOT, "trace": str(options.trace), **numbers, "time_ns": traced.time_ns, "session": facts,
             "rows": rows}
        )  # fmt: skip
        return 0
    split = f", split {printable(session.split)}" if session.split else ""
    print_line(
        f"frame {traced.index:,}: episode {traced.episode:,}, frame {traced.frame:,}, time_ns {traced.time_ns}",
        f"  of {printable(session.name)}{split}",
        f"  SHA-256 {session.sha256}",
    )
    for row in traced.rows:
        _print_row(row, has_recording=traced.recording is not None)
    return 0


def _print_row(row: TracedRow, *, has_recording: bool) -> None:
    name = f"{row.feature}: {row.row} of the next frame" if row.next_frame else row.row
    more = ", held" if row.held else ""
    between = f", {row.share:.6g} of the way to the second" if row.messages[1:] and row.share else ""
    print_line(printable(f"{name}, {row.stream}{between}{more}"))
    if not row.messages:
        print_line("  behind the last frame of the episode: the recording has it" if row.next_frame else "  no message")
    for each in row.messages:
        entry = f"entry {each.entry:,}, " if each.entry else ""
        print_line(f"  {entry}stamp_ns {each.stamp_ns}")
        if has_recording:
            print_line(f"    {_place_text(each.place)}")


def _place_text(place: MessagePlace | None) -> str:
    if place is None:
        return "not among the messages of the file: it was latched before its start"
    file = f"{count_text(place.length, 'byte')} of {printable(place.path.name)} at"
    if place.file_at is not None:
        return f"{file} {place.file_at:,}"
    return (
        f"{file} {place.offset:,} of the {place.compression} chunk at {place.chunk_at:,}, whose data are "
        f"{count_text(place.data_length, 'byte')} at {place.data_at:,}"
    )


def _place(place: MessagePlace | None) -> dict[str, Any] | None:
    """The place of a message as JSON."""
    if place is None:
        return None
    return {**asdict(place), "path": str(place.path), "file_at": place.file_at}
