"""What a session gives to a data set, before anything is written, and how it differs from the others.

It is plain JSON, because a session may be described in another program or on another machine.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from igtl_gateway.addon.terminal import few_text
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addons.lerobot.recipe import Recipe

#: Sessions, and numbers of a row, that an error lists.
_MOST = 5
#: Rates of one stream that differ by more than this factor are others.
RATE = 1.25
#: Samples from which on a stream has a rate.
LEAST_SAMPLES = 10


@dataclass(frozen=True, slots=True)
class RowFacts:
    """A row of the recipe in a session.

    Attributes:
        row: its number.
        feature, stream, type: names of the feature, the stream and the type of its messages.
        names: names of its numbers in the recording.
        units: as far as the recording states them.
        size: rows and columns of its pictures.
        rate_hz: samples per second; 0 for a stream without a rate.
    """

    row: int
    feature: str
    stream: str
    type: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    size: tuple[int, ...]
    rate_hz: float

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> RowFacts:
        """Return the facts that ``asdict`` made a dictionary of."""
        lists = {each: tuple(value[each]) for each in ("names", "units", "size")}
        return cls(**{**value, **lists, "rate_hz": float(value["rate_hz"])})


@dataclass(frozen=True, slots=True)
class Described:
    """A session as it will be in the data set.

    Attributes:
        path: of the recording.
        name: of its file, with the folders that ``splits.patient`` has.
        sha256: of its content.
        start_ns: gateway time of its first entry.
        clock: ``source`` or ``gateway``.
        features: for info.json.
        rows: of the recipe.
        episodes: number of frames and task of each.
        splits: of one session whose recipe has ranges of demonstrations.
    """

    path: str
    name: str
    sha256: str
    start_ns: int
    clock: str
    features: Mapping[str, Any]
    rows: tuple[RowFacts, ...]
    episodes: tuple[tuple[int, str], ...]
    splits: Mapping[str, str]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return sum(count for count, _ in self.episodes)

    @property
    def order(self) -> tuple[int, str]:
        """The order of sessions in a data set: that of time, in whatever order they are named."""
        return self.start_ns, self.sha256

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> Described:
        """Return what ``to_dict`` made a dictionary of."""
        rows = tuple(RowFacts.of(each) for each in value["rows"])
        episodes = tuple((int(count), str(task)) for count, task in value["episodes"])
        return cls(**{**value, "rows": rows, "episodes": episodes})


@dataclass(frozen=True, slots=True)
class Schema:
    """What all sessions of a data set have in common.

    Attributes:
        clock, features, rows: as in ``Described``.
        name: of a session that has it.
        is_own: whether the features are those that this program writes; otherwise those of another one.
    """

    clock: str
    features: Mapping[str, Any]
    rows: tuple[RowFacts, ...]
    name: str
    is_own: bool = True

    @property
    def names(self) -> dict[int, tuple[str, ...]]:
        """Row of the recipe → names of its numbers, in the order of the data set."""
        return {each.row: each.names for each in self.rows if each.names}

    def unlike(self, features: Mapping[str, Any], besides: Collection[str] = ()) -> list[str]:
        """Return how features differ: place, found and expected; those of ``besides`` are not compared."""
        one, two = (
            {name: each for name, each in all.items() if name not in besides} for all in (features, self.features)
        )
        if not self.is_own:
            return unlike(one, two)
        return [
            f"{name}: found {_short(one.get(name))}, expected {_short(two.get(name))}"
            for name in sorted({*one, *two})
            if one.get(name) != two.get(name)
        ]


def schema_of(sessions: Sequence[Described]) -> Schema:
    """Return the schema that most sessions have, with the middle rates; of several, that of the first session."""
    kinds = [_key(each) for each in sessions]
    most = max(Counter(kinds).values())
    first = next(each for each, kind in zip(sessions, kinds, strict=True) if kinds.count(kind) == most)
    rates = [[each.rows[number].rate_hz for each in sessions] for number in range(len(first.rows))]
    rows = (
        RowFacts.of(asdict(row) | {"rate_hz": median([each for each in own if each] or [0.0])})
        for row, own in zip(first.rows, rates, strict=True)
    )
    return Schema(first.clock, first.features, tuple(rows), first.name)


def _key(session: Described) -> str:
    rows = [(each.type, sorted(each.names), each.units, each.size) for each in session.rows]
    return json.dumps([session.clock, rows], sort_keys=True)


def differences(session: Described, schema: Schema, recipe: Recipe) -> list[str]:
    """Return how a session differs: place, found and expected.  Names in another order are no difference."""
    found = list(_differences(session, schema, recipe))
    if found:
        return found
    alike = {each.row for each, other in zip(session.rows, schema.rows, strict=True) if each.names == other.names}
    moved = {each.feature for each in session.rows if each.row not in alike}
    moved |= {row.name for row in recipe.features if row.next_of in moved}
    return schema.unlike(session.features, moved)


def unlike(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """Return how features differ from those of a data set of another program: in types, shapes, names and videos.

    Names that are not stated there are no difference, and neither are statements about a video that only one has.
    """
    wrong = []
    for name in sorted({*found, *expected}):
        if name not in expected or name not in found:
            where, other = ("recipe", "data set") if name in found else ("data set", "recipe")
            wrong.append(f"{printable(name)}: found it in the {where} and not in the {other}, expected it in both")
            continue
        one, two = found[name], expected[name]
        facts = {key: (one[key], two[key]) for key in ("dtype", "shape")}
        if (names := flat_names(two.get("names"))) and one["dtype"] != "video":
            facts["names"] = one["names"], names
        info = two.get("info")
        facts |= {
            key: (value, info[key])
            for key, value in one.get("info", {}).items()
            if isinstance(info, dict) and key in info
        }
        wrong += [
            f"{name}: {key}: found {_short(each[0])}, expected {_short(each[1])}"
            for key, each in facts.items()
            if each[0] != each[1]
        ]
    return wrong


def flat_names(names: Any) -> Any:
    """Names as a list, also those in a table of one group, as ``{"motors": […]}``."""
    return next(iter(names.values())) if isinstance(names, dict) and len(names) == 1 else names


def _differences(session: Described, schema: Schema, recipe: Recipe) -> Iterator[str]:
    as_other = f"as in {printable(schema.name)}"
    if session.clock != schema.clock:
        yield (f"clock: found {session.clock}, expected {schema.clock} {as_other}; set dataset.clock for all of them")
    for one, two in zip(session.rows, schema.rows, strict=True):
        place = f"feature[{one.row}] ({one.feature}, {printable(one.stream)})"
        if one.type != two.type:
            yield f"{place}: type: found {one.type}, expected {two.type} {as_other}"
            continue
        if sorted(one.names) != sorted(two.names):
            yield f"{place}: names: {_names(one.names, two.names)} {as_other}"
        if one.units != two.units:
            yield f"{place}: units: found {_list(one.units)}, expected {_list(two.units)} {as_other}"
        if one.size != two.size:
            yield f"{place}: pictures: found {_size(one.size)} pixels, expected {_size(two.size)} {as_other}"
        if recipe.rates == "same" and one.rate_hz and two.rate_hz:
            factor = one.rate_hz / two.rate_hz
            if not 1 / RATE <= factor <= RATE:
                yield (
                    f"{place}: rate: found {one.rate_hz:.4g} Hz, expected about {two.rate_hz:.4g} Hz as in the others; "
                    'dataset.rates = "any" accepts it'
                )


def _names(found: Sequence[str], expected: Sequence[str]) -> str:
    """What is missing, what is there in addition, and what is expected."""
    missing, more = ([each for each in one if each not in two] for one, two in ((expected, found), (found, expected)))
    parts = [f"no {_list(missing)}"] if missing else []
    parts += [_list(more)] if more else []
    return f"found {' and '.join(parts) or _list(found)}, expected {_list(expected)}"


def _list(values: Sequence[str]) -> str:
    return few_text((printable(each) or "none" for each in values), _MOST) or "none"


def _size(size: Sequence[int]) -> str:
    return " × ".join(map(str, reversed(size)))


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return printable(text if len(text) <= 120 else f"{text[:120]}…")
