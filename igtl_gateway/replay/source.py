"""What a replay sends: the bytes of that day, or those of today's gateway for the inputs of that day."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from igtl_gateway.config import Config
from igtl_gateway.gateway import LINK_UP, gateway_of
from igtl_gateway.globs import matches
from igtl_gateway.session.entry import Entry, Kind
from igtl_gateway.session.note import Level, Note

#: The link that stands for "whoever listens" where a recording knows of no link.
_ANY_LINK = 1


def through_gateway(entries: Iterable[Entry], config: Config, *, has_links: bool) -> Iterator[Entry]:
    """Inputs and outputs of today's gateway for the recorded inputs.

    Args:
        has_links: whether the recording tells of links; if not, one that reads header version 1 is assumed.
    """
    gateway = gateway_of(config)
    if not has_links:
        note = Note(Level.INFO, LINK_UP, "replay").pack()
        gateway.handle(Entry(0, 0, Kind.LINK, payload=(note,), links=(_ANY_LINK,)))
    for entry in entries:
        if entry.kind.is_input:
            yield entry
            yield from gateway.handle(entry)


def once(entries: Iterable[Entry]) -> Iterator[Entry]:
    """Of a message that went out in several header versions only the first form: version 1 where it was sent."""
    sent: set[str] = set()
    for entry in entries:
        if entry.kind is Kind.IGTL_OUT:
            if entry.channel in sent:
                continue
            sent.add(entry.channel)
        elif sent and entry.kind in _INPUTS:
            sent.clear()
        yield entry


def spoken_to(role: str, entries: Iterable[Entry]) -> Iterator[Entry]:
    """Of a relay's recording the inputs, and of the outputs the words to one side.

    Args:
        role: our own in the replay.  ``"server"``: what was sent to those that had connected to the relay, which is
            what their server said; ``"client"``: what was sent to that server.
    """
    listeners: set[int] = set()
    for entry in entries:
        if entry.kind is Kind.LINK:
            note = Note.unpack(entry.data())
            if note.code == LINK_UP and note.data.get("role") == role:
                listeners.update(entry.links)
        if entry.kind.is_input or listeners.intersection(entry.links):
            yield entry


def select(entries: Iterable[Entry], kinds: frozenset[Kind], streams: Iterable[str] = ()) -> Iterator[Entry]:
    """Entries of some kinds, of streams that match one of the globs (no glob: all).

    A glob fits the channel (``TYPE/device`` or the topic) or the device name alone.
    """
    globs = tuple(streams)
    few = tuple(kinds)  # found sooner than by their hash
    known: dict[str, bool] = {}
    for entry in entries:
        if entry.kind in few:
            if entry.channel not in known:
                known[entry.channel] = fits(entry.channel, globs) or (
                    entry.kind in _IGTL and fits(entry.channel.partition("/")[2], globs)
                )
            if known[entry.channel]:
                yield entry


def fits(name: str, globs: Sequence[str]) -> bool:
    """Whether a name matches one of the globs, or there is none."""
    return not globs or any(matches(glob, name) for glob in globs)


_IGTL = frozenset({Kind.IGTL_IN, Kind.IGTL_OUT})
_INPUTS = frozenset(kind for kind in Kind if kind.is_input)
