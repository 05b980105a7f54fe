"""The rows of a profile that nothing in a session matches: a name with a mistake hides nothing, or keeps nothing."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from igtl_gateway.addon import did_you_mean, matches, near_names, near_streams
from igtl_gateway.addons.deidentify.profile import Profile


@dataclass(slots=True)
class Asked:
    """What the rules of a profile were asked about in a session.

    Attributes:
        streams: ``TYPE/device`` and topics, as in the recording.
        names: names and their parts.
        keys: keys of metadata.
        types: types without a known layout.
    """

    streams: set[str] = field(default_factory=set)
    names: set[str] = field(default_factory=set)
    keys: set[str] = field(default_factory=set)
    types: set[str] = field(default_factory=set)


def unused_rows(profile: Profile, asked: Asked) -> dict[str, str]:
    """Return the rows that match nothing: place in the profile → question about near names of the recording."""
    rows: list[tuple[str, str, set[str]]] = [
        *((f"keep.names[{at}]", glob, asked.names) for at, glob in enumerate(profile.keep_names)),
        *((f"keep.metadata[{at}]", glob, asked.keys) for at, glob in enumerate(profile.keep_metadata)),
        *((f"keep.types[{at}]", glob, asked.types) for at, glob in enumerate(profile.keep_types)),
        *((f"names.{name}", name, asked.names) for name in profile.names),
        *((f"text[{at}]", rule.stream, asked.streams) for at, rule in enumerate(profile.text_rules)),
        *((f"mask[{at}]", mask.stream, asked.streams) for at, mask in enumerate(profile.masks)),
    ]
    return {place: _question(glob, names) for place, glob, names in rows if not _is_used(place, glob, names)}


def _is_used(place: str, glob: str, names: Iterable[str]) -> bool:
    return glob in names if place.startswith("names.") else any(matches(glob, name) for name in names)


def _question(glob: str, names: Iterable[str]) -> str:
    return did_you_mean(near_streams(glob, names) or near_names(glob, sorted(names)))
