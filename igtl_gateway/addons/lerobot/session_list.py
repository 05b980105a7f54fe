"""``meta/sessions.json``: which sessions a data set is made of, and what the next ones have to fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.untrusted import parse_json, read_bytes, shape
from igtl_gateway.addons.lerobot.depth import LEVELS as DEPTH_LEVELS
from igtl_gateway.addons.lerobot.schema import RowFacts
from igtl_gateway.addons.lerobot.stats import PictureStats

SESSIONS = "sessions.json"
VERSION = 1
_LEVELS = 256

_TEXTS = shape.list_of(shape.text)
_SESSION = shape.fields(
    {
        "name": shape.text, "sha256": shape.text, "start_ns": shape.number, "group": shape.text, "split": shape.text,
        "episodes": shape.number, "frames": shape.number, "unaligned": shape.number, "notes": _TEXTS,
    },
    ("name", "sha256", "start_ns", "group", "split", "episodes", "frames", "unaligned", "notes"),
)  # fmt: skip
_ROW = shape.fields(
    {
        "row": shape.number, "feature": shape.text, "stream": shape.text, "type": shape.text, "names": _TEXTS,
        "units": _TEXTS, "size": shape.list_of(shape.number), "rate_hz": shape.anything,
    },
    ("row", "feature", "stream", "type", "names", "units", "size", "rate_hz"),
)  # fmt: skip
_PICTURES = shape.fields(
    {
        "pictures": shape.number,
        "counts": shape.list_of(shape.list_of(shape.number)),
        "low": shape.anything,
        "high": shape.anything,
    },
    ("pictures", "counts"),
)
_LIST = shape.fields(
    {
        "version": shape.number, "clock": shape.text, "card": shape.text, "rows": shape.list_of(_ROW),
        "pictures": shape.map_of(_PICTURES), "sessions": shape.list_of(_SESSION), "others": shape.number,
    },
    ("version", "clock", "card", "rows", "pictures", "sessions"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class SetSession:
    """A session of a data set.

    Attributes:
        name: of the file of the recording, with the folders that ``splits.patient`` has.
        sha256: of its content.
        start_ns: gateway time of its first entry.
        group: session or patient, which has one split.
        split: of the session; "": its demonstrations have several.
        episodes, frames: their number, after those of the sessions before.
        unaligned: episodes with streams that were not aligned.
        notes: of its clock.
    """

    name: str
    sha256: str
    start_ns: int
    group: str
    split: str
    episodes: int
    frames: int
    unaligned: int
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SessionList:
    """The sessions of a data set, in their order.

    Attributes:
        clock, rows: of its schema.
        pictures: feature → how often each value occurs in the sampled pictures.
        sessions: the sessions.
        card: SHA-256 of the card as it was written.
        others: episodes of another program, which come before those of the sessions.
    """

    clock: str = ""
    rows: tuple[RowFacts, ...] = ()
    pictures: Mapping[str, PictureStats] = field(default_factory=dict)
    sessions: tuple[SetSession, ...] = ()
    card: str = ""
    others: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            "version": VERSION,
            "clock": self.clock,
            "card": self.card,
            "others": self.others,
            "rows": [asdict(each) for each in self.rows],
            "pictures": {name: each.to_dict() for name, each in self.pictures.items()},
            "sessions": [asdict(each) for each in self.sessions],
        }


def read_session_list(root: Path) -> SessionList | None:
    """Return the sessions of a data set; None for one of another program.  Raises DamagedRecording."""
    path = root / "meta" / SESSIONS
    if not path.is_file():
        return None
    value = parse_json(read_bytes(path).decode("utf-8", "replace"), str(path))
    _LIST(value, str(path))
    if value["version"] != VERSION:
        raise shape.wrong(f"{path}: version", value["version"], str(VERSION))
    for number, row in enumerate(value["rows"]):
        if not isinstance(row["rate_hz"], int | float) or not 0 <= row["rate_hz"] < 1e9:
            raise shape.wrong(f"{path}: rows[{number}].rate_hz", row["rate_hz"], "a rate in Hz")
    for name, each in value["pictures"].items():
        sizes = [len(counts) for counts in each["counts"]]
        if sizes not in ([_LEVELS] * 3, [DEPTH_LEVELS]) or min(map(min, each["counts"])) < 0:
            raise DamagedRecording(f"{path}: pictures.{name}.counts: expected 3 lists of {_LEVELS} numbers, or one of "
                                   f"{DEPTH_LEVELS}")  # fmt: skip
        for key in ("low", "high"):
            if not isinstance(each.get(key, 0.0), int | float) or not 0 <= each.get(key, 0.0) < 1e6:
                raise shape.wrong(f"{path}: pictures.{name}.{key}", each[key], "a depth in mm")
    sessions = (SetSession(**{**each, "notes": tuple(each["notes"])}) for each in value["sessions"])
    pictures = {name: pictures_of(each) for name, each in value["pictures"].items()}
    rows = tuple(RowFacts.of(each) for each in value["rows"])
    return SessionList(value["clock"], rows, pictures, tuple(sessions), value["card"], value.get("others", 0))


def pictures_of(value: Mapping[str, Any]) -> PictureStats:
    """Return the statistics that ``PictureStats.to_dict`` made a dictionary of."""
    counts = np.array(value["counts"], np.int64)
    return PictureStats(counts, int(value["pictures"]), value.get("low", 0.0), value.get("high", 1.0))


def joined_pictures(parts: Sequence[Mapping[str, PictureStats]]) -> dict[str, PictureStats]:
    """Return the statistics of the pictures of several parts together: sums of numbers, so in any order the same."""
    found: dict[str, PictureStats] = {}
    for part in parts:
        for name, each in part.items():
            found.setdefault(name, PictureStats()).join(each)
    return found
