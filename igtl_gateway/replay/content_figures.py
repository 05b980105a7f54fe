"""The summary of a recording from the figures that its recorder wrote at its end: only the notes are read.

The figures have to agree with the counts and times of the index; else all entries are read, as in a file without any.
"""

from __future__ import annotations

from collections import Counter

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.gateway.log.clocksteps import ClockStep
from igtl_gateway.record.sessionfile import figures, layout
from igtl_gateway.record.sessionfile.channels import ChannelSummary
from igtl_gateway.record.sessionfile.columns import Stream, Unfit
from igtl_gateway.record.sessionfile.figures import StatedFigures
from igtl_gateway.record.sessionfile.index import recover_hint
from igtl_gateway.record.sessionfile.layout import LayoutError
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.content_columns import content_of
from igtl_gateway.replay.content_summary import ContentSummary, StreamSummary


class _Unlike(Exception):
    """The figures are not those of the file."""


def summary_of(file: SessionFile, begin_ns: int = 0, *, full: bool = False) -> tuple[ContentSummary, str | None]:
    """The summary of all entries, and why it is not from figures: ``""`` where there are none, or they are not wanted
    (``full``); None if it is.  ``begin_ns`` as of ContentSummary.

    Raises as SessionFile.entries.
    """
    why = ""
    if not full:
        try:
            found = _stated(file, begin_ns)
            if found is not None:
                return found, None
        except (_Unlike, LayoutError) as error:
            why = str(error)
        except GatewayError as error:  # of the record, or above a limit; if of the entries, it is found again
            why = str(error).removeprefix(f"{file.path}: ").removesuffix(recover_hint(file.path))
    return content_of(file, begin_ns), why


def _stated(file: SessionFile, begin_ns: int) -> ContentSummary | None:
    if file.foreign or file.format_version not in layout.PRESENT_VERSIONS or begin_ns:
        return None
    items = file.figures()
    if items is None:
        return None
    if (version := items.get(figures.VERSION_KEY)) != figures.VERSION:
        raise _Unlike(f"figures: found version {version}, expected {figures.VERSION}")
    text = items.get(figures.SO_FAR if file.parts else figures.FILE)
    if text is None:
        return None
    stated = figures.parse_figures(text)
    content = ContentSummary()
    try:
        for columns in file.columns(wanted=_is_note):
            for entry in columns.entries():
                content.add(entry)
    except Unfit:
        return None
    _compare(stated, file, content.steps)
    _fill(content, stated, file.entry_count)
    return content


def _is_note(stream: Stream) -> bool:
    return stream.kind in layout.NOTE_KINDS


def _compare(stated: StatedFigures, file: SessionFile, steps: list[ClockStep]) -> None:
    """Raise _Unlike where the figures are not those of entries that the file can have."""
    expected: Counter[tuple[object, str, str]] = Counter()
    for channel in file.channels:
        if channel.count and channel.kind not in layout.NOTE_KINDS:
            expected[_stream_of(channel)] += channel.count
    found = {(each.kind, each.channel, each.type): each.messages for each in stated.streams}
    if found != expected:
        raise _Unlike(
            f"figures: found {count_text(sum(found.values()), 'message')} of {count_text(len(found), 'stream')}, "
            f"the index has {expected.total():,} of {len(expected)}, or others"
        )
    jumped_ns = sum(step.jump_ns for step in steps)
    for each in stated.streams:
        if not file.start_ns <= each.first_ns <= each.last_ns <= file.end_ns + jumped_ns:
            raise _Unlike(f"figures: found a time of {each.channel!r} outside of the recording")
        span_ns = each.last_ns - each.first_ns
        if not steps and not span_ns <= each.longest_pause_ns * (each.messages - 1) <= span_ns * (each.messages - 1):
            raise _Unlike(
                f"figures: found a pause of {each.longest_pause_ns} ns in {each.channel!r}, within {span_ns} ns"
            )
        if each.bytes > file.most_bytes:
            raise _Unlike(f"figures: found {count_text(each.bytes, 'byte')} of {each.channel!r}, more than there are")


def _stream_of(channel: ChannelSummary) -> tuple[object, str, str]:
    return channel.kind, channel.stream, channel.entry_type


def _fill(content: ContentSummary, stated: StatedFigures, entries: int) -> None:
    content.entries = entries
    for each in stated.streams:
        content.streams[each.kind, each.channel, each.type] = StreamSummary(
            each.kind, each.channel, each.type, each.messages, 0, each.bytes, each.first_ns, each.last_ns,
            each.longest_pause_ns, each.unstamped, links=set(each.links), stated_age_ns=each.age_ns,
        )  # fmt: skip
    for (link, channel), timing in stated.clocks.items():
        content.clocks.setdefault(link, {})[channel] = timing
