"""Finds what other programs did to an exported set: episodes that are gone or new, splits that are lost.

LeRobot's tools know neither the list of sessions nor the splits: after a delete, all episodes are in ``train``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.terminal import by_count, count_text, few_text
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addons.lerobot.provenance import ExportedEpisode, exported_episodes, origins
from igtl_gateway.addons.lerobot.reading import FoundDataSet
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList, read_session_list
from igtl_gateway.addons.lerobot.splits import TRAIN, has_ranges, owners_of, runs
from igtl_gateway.addons.lerobot.writing import RECIPE

#: Episodes that are listed.
_MOST = 5
_PLACE, _SPLITS = f"meta/{SESSIONS}", "meta/info.json: splits"
_HELD_OUT = ": held-out episodes have become training data"


def check_edits(found: FoundDataSet) -> Iterator[str]:
    """Yield the differences between a set and its list of sessions; nothing for a set of another program."""
    try:
        listed = read_session_list(found.root)
        if listed is None:
            return
        exported = exported_episodes(found.root, listed)
    except GatewayError as error:
        yield str(error)
        return
    known = origins(found, exported, listed.others)
    if known is None:
        yield (
            f"{_PLACE}: found {count_text(len(found.episodes), 'episode')} of other lengths, expected the "
            f"{len(exported):,} of the export: the set was edited"
        )
        return
    yield from _episodes(known, exported, listed)
    yield from _splits(found, known, exported, listed)
    yield from _names(found)


def _episodes(known: Sequence[int | None], exported: Sequence[ExportedEpisode], listed: SessionList) -> Iterator[str]:
    """Episodes that are gone, and those of no session."""
    gone = sorted(set(range(len(exported))) - set(known))
    for each in gone[:_MOST]:
        one = exported[each]
        name = printable(listed.sessions[one.session].name)
        number = listed.others + each
        yield f"{_PLACE}: found no episode {one.number} of {name}, expected it: it was episode {number} and is gone"
    if len(gone) > _MOST:
        yield f"{_PLACE}: {len(gone) - _MOST:,} more episodes are gone"
    added = [number for number, each in enumerate(known, listed.others) if each is None]
    if added:
        yield (
            f"{_PLACE}: found {by_count(len(added), 'episode', 'episodes')} {runs(added)} of no session, expected "
            "those of the export"
        )


def _splits(
    found: FoundDataSet, known: Sequence[int | None], exported: Sequence[ExportedEpisode], listed: SessionList
) -> Iterator[str]:
    """Episodes in another split than at their export, and splits without an episode."""
    sessions = listed.sessions
    owners = owners_of(found.info["splits"], len(found.episodes))
    moved: dict[tuple[str, str], list[int]] = {}
    for number, each in enumerate(known, listed.others):
        if each is not None and (split := sessions[exported[each].session].split) not in ("", owners[number]):
            moved.setdefault((split, owners[number]), []).append(number)
    for (split, owner), numbers in moved.items():
        names = dict.fromkeys(
            sessions[exported[each].session].name
            for number in numbers
            if (each := known[number - listed.others]) is not None
        )
        yield (
            f"{_SPLITS}: found {by_count(len(numbers), 'episode', 'episodes')} {runs(numbers)} "
            f"({_few(list(names))}) in {owner or 'none'}, expected {split} as exported{_HELD_OUT * (owner == TRAIN)}"
        )
    kept = {sessions[exported[each].session].split for each in known if each is not None}
    for split in dict.fromkeys(each.split for each in sessions if each.split and each.episodes):
        if split not in kept:
            yield f"{_SPLITS}.{split}: found no episode, expected those of the export: all of them are gone"


def _names(found: FoundDataSet) -> Iterator[str]:
    """Splits of demonstrations that are not there: their names are in the recipe, their episodes in no file."""
    try:
        splits = read_recipe(found.root / "meta" / RECIPE).splits
    except GatewayError:
        return  # the comparison has it
    for name, value in (splits or {}).items() if has_ranges(splits) else ():
        if name not in found.info["splits"]:
            yield (
                f"{_SPLITS}.{name}: found no episode, expected those of the demonstrations {value} of meta/{RECIPE}"
                f"{_HELD_OUT * (name != TRAIN and list(found.info['splits']) == [TRAIN])}"
            )


def _few(names: Sequence[str]) -> str:
    return few_text(map(printable, names), _MOST)
