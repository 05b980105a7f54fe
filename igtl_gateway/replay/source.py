"""What a replay sends: the bytes of that day, or those of today's gateway for the inputs of that day."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from igtl_gateway.config import Config
from igtl_gateway.gateway import LINK_UP, Session, make_core
from igtl_gateway.globs import matches
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

#: The link that stands for "whoever listens" where a recording knows of no link.
_ANY_LINK = 1

#: Why a replay passes over a message: names in its account.
FORMS, RELAY, STREAMS, MADE_ANEW = "other_forms", "other_side", "not_chosen", "made_anew"


def through_gateway(
    entries: Iterable[Entry], config: Config, *, has_links: bool, made: Counter[Kind] | None = None
) -> Iterator[Entry]:
    """Inputs and outputs of today's gateway for the recorded inputs.

    Args:
        has_links: whether the recording tells of links; if not, one that reads header version 1 is assumed.
        made: counts the outputs.
    """
    made = Counter() if made is None else made
    session = Session(make_core(config, fast_path=False))
    if not has_links:
        note = Note(Level.INFO, LINK_UP, "replay").pack()
        session.recorded(Entry(0, 0, Kind.LINK, payload=(note,), links=(_ANY_LINK,)))
    for entry in entries:
        if entry.kind.is_input:
            yield entry
            for output in session.recorded(entry):
                made[output.kind] += 1
                yield output


def first_form_only(entries: Iterable[Entry], passed_over: Counter[str] | None = None) -> Iterator[Entry]:
    """Of a message that went out in several header versions only the first form: version 1 where it was sent.

    Args:
        passed_over: counts the others.
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
    """Of a relay's recording the inputs, and of the outputs the words to one side.

    Args:
        passed_over: counts the outputs that are left out.
        role: our own in the replay.  ``"server"``: what was sent to those that had connected to the relay, which is
            what their server said; ``"client"``: what was sent to that server.
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
    """Entries of some kinds, of streams that match one of the globs (no glob: all).

    A glob fits the channel (``TYPE/device`` or the topic) or the device name alone.  ``passed_over`` counts the
    entries of other streams.
    """
    passed_over = Counter() if passed_over is None else passed_over
    globs = tuple(streams)
    few = tuple(kinds)  # found sooner than by their hash
    known: dict[str, bool] = {}
    for entry in entries:
        if entry.kind in few:
            if entry.channel not in known:
                known[entry.channel] = matches_any(entry.channel, globs) or (
                    entry.kind in _IGTL and matches_any(entry.channel.partition("/")[2], globs)
                )
            if known[entry.channel]:
                yield entry
            else:
                passed_over[STREAMS] += 1


def matches_any(name: str, globs: Sequence[str]) -> bool:
    """Whether a name matches one of the globs, or there is none."""
    return not globs or any(matches(glob, name) for glob in globs)


_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_INPUTS = frozenset(kind for kind in Kind if kind.is_input)
