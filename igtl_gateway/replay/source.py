"""The entries that a replay sends: recorded outputs, or outputs computed from the recorded inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.base.globs import matches
from igtl_gateway.base.near import streams_expected, unmatched, without_match
from igtl_gateway.base.quantities import count_text
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, Session, make_core
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.sessionfile.reader import SessionFile

#: The link for all peers, for recordings without links.
_ANY_LINK = 1

#: Reasons for which a replay skips a message, in its account.
FORMS, RELAY, STREAMS, RECOMPUTED = "other_forms", "other_side", "not_chosen", "made_anew"


def through_gateway(
    entries: Iterable[Entry],
    config: Config,
    *,
    has_links: bool,
    before: Iterable[Entry] = (),
    made: Counter[Kind] | None = None,
) -> Iterator[Entry]:
    """Yield the recorded inputs and the outputs that the gateway computes from them.

    Args:
        before: the prologue of the recording; its inputs and their outputs come first.
        has_links: whether the recording has links; if not, one peer with header version 1 is assumed.
        made: counts the computed outputs.
    """
    made = Counter() if made is None else made
    session = Session(make_core(config, fast_path=False))
    if not has_links:
        note = Note(Level.INFO, LINK_UP, "replay").pack()
        session.recorded(Entry(0, 0, Kind.LINK, payload=(note,), links=(_ANY_LINK,)))
    for group in input_groups(before):
        yield from _counted(group.input, session.restored(group.input, group.outputs), made)
    for entry in entries:
        if entry.kind.is_input:
            yield from _counted(entry, session.recorded(entry), made)


def _counted(entry: Entry, outputs: Sequence[Entry], made: Counter[Kind]) -> Iterator[Entry]:
    yield entry
    for output in outputs:
        made[output.kind] += 1
        yield output


def first_form_only(entries: Iterable[Entry], passed_over: Counter[str] | None = None) -> Iterator[Entry]:
    """Yield only the first form of a message that was sent in several header versions: version 1 if it was sent.

    Args:
        passed_over: counts the skipped forms.
    """
    passed_over = Counter() if passed_over is None else passed_over
    sent: set[str] = set()
    for entry in entries:
        if entry.kind is Kind.IGTL_OUT:
            if entry.channel in sent:
                passed_over[FORMS] += 1
                continue
            sent.add(entry.channel)
        elif sent and entry.kind in _INPUTS:
            sent.clear()
        yield entry


def one_side_of_relay(role: str, entries: Iterable[Entry], passed_over: Counter[str] | None = None) -> Iterator[Entry]:
    """Yield the inputs of a relay's recording, and the outputs to one side.

    Args:
        passed_over: counts the skipped outputs.
        role: role of the replay.  ``"server"``: messages to the clients of the relay, which come from their server;
            ``"client"``: messages to that server.
    """
    passed_over = Counter() if passed_over is None else passed_over
    listeners: set[int] = set()
    for entry in entries:
        if entry.kind is Kind.LINK:
            note = Note.of(entry.data())
            if note.code == LINK_UP and note.data.get("role") == role:
                listeners.update(entry.links)
        if entry.kind.is_input or listeners.intersection(entry.links):
            yield entry
        elif entry.kind is Kind.IGTL_OUT:
            passed_over[RELAY] += 1


def select_entries(
    entries: Iterable[Entry],
    kinds: frozenset[Kind],
    streams: Iterable[str] = (),
    passed_over: Counter[str] | None = None,
) -> Iterator[Entry]:
    """Yield the entries of some kinds from streams that match one of the globs (no glob: all).

    A glob matches the channel (``TYPE/device`` or the topic) or the device name.  ``passed_over`` counts the entries of
    other streams.
    """
    passed_over = Counter() if passed_over is None else passed_over
    globs = tuple(streams)
    few = tuple(kinds)  # faster than a set
    known: dict[str, bool] = {}
    for entry in entries:
        if entry.kind in few:
            if entry.channel not in known:
                known[entry.channel] = is_stream_of(entry.kind, entry.channel, globs)
            if known[entry.channel]:
                yield entry
            else:
                passed_over[STREAMS] += 1


def is_stream_of(kind: Kind, channel: str, globs: Sequence[str]) -> bool:
    """Return whether a topic, or ``TYPE/device`` or its device name, matches one of the globs, or there is no glob."""
    return matches_any(channel, globs) or (kind in _IGTL and matches_any(channel.partition("/")[2], globs))


def check_recorded(files: Sequence[SessionFile], globs: Sequence[str], place: str = "--streams") -> list[str]:
    """Return a sentence about each glob that matches no recorded stream of the files, with near names.

    Streams that share a channel of a file have no name before they are read: then nothing is returned.

    Raises ConfigError if no glob matches one.
    """
    channels = [each for file in files for each in file.channels if each.count and each.kind in _MESSAGES]
    names = {each.stream or each.topic for each in channels}
    without = without_match(globs, names)
    if not without or any(each.kind in _IGTL and not each.stream for each in channels):
        return []
    if len(without) < len(globs):
        return [f"{place} {glob}: {unmatched(glob, names)}" for glob in without]
    raise ConfigError(
        f"{place}: found {', '.join(map(repr, without))}, {streams_expected(without, names, files[0].path)}"
    )


def without_messages(file: SessionFile) -> GatewayError:
    """Return the error about a recording without an entry that can be read: what it has instead."""
    left = [f"{each.topic}: {count_text(each.count, 'message')}, {each.why}" for each in file.skipped[:_NAMED]]
    more = [f"{len(file.skipped) - _NAMED:,} more"] if len(file.skipped) > _NAMED else []
    found = f"no messages that can be read ({'; '.join([*left, *more])})" if left else "no messages"
    return GatewayError(f"{file.path}: found {found}, expected at least one")


def matches_any(name: str, globs: Sequence[str]) -> bool:
    """Return whether a name matches one of the globs, or there is no glob."""
    return not globs or any(matches(glob, name) for glob in globs)


#: Channels that an error lists.
_NAMED = 3
_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_MESSAGES = _IGTL | {Kind.ROS_IN, Kind.ROS_OUT}
_INPUTS = frozenset(kind for kind in Kind if kind.is_input)
