"""Checks of session metadata and ledger, as ``docs/reference/session-log.md`` has them.

Readers check here once; code that prints or counts may rely on the types.  Fields that are not in the tables are kept
unchecked.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from igtl_gateway.base.errors import ConfigError, DamagedRecording
from igtl_gateway.base.untrusted.shape import (
    Shape,
    anything,
    digits,
    fields,
    list_of,
    map_of,
    number,
    text,
    truth,
    wrong,
)
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.record.sessionfile import layout

_COUNTS = map_of(number)
#: Of a stream: fates of its messages.
_FATES = fields({"dropped": _COUNTS}, other=number)

_LEDGER = fields(
    {
        "streams": map_of(map_of(_FATES)),
        "links": map_of(
            fields(
                {
                    "dropped": _COUNTS,
                    "ignored": _COUNTS,
                    "sent_messages": number,
                    "received_messages": number,
                    "queued_messages": number,
                }
            )
        ),
        "link_faults": _COUNTS,
        "ros_topics": map_of(fields({"lost": number})),
        "video": map_of(map_of(fields({"dropped": _COUNTS, "changed": _COUNTS}, other=number))),
        "recorder": fields(
            {
                "dropped": _COUNTS,
                "left_out": _COUNTS,
                "dropped_entries": number,
                "left_out_entries": number,
                "written_entries": number,
            }
        ),
        layout.TRIGGERS_KEY: list_of(
            fields(
                {
                    **dict.fromkeys(("rule", "why", "missing"), text),
                    **dict.fromkeys(("at_ns", "last_ns", "count"), number),
                },
                needed=("rule", "why", "missing", "at_ns", "last_ns", "count"),
            )
        ),
        "recovered": fields(
            {"by": text, "from": text, "whole": truth, "lost": list_of(anything), "more_lost": number},
            needed=("by", "from", "whole", "lost", "more_lost"),
        ),
    }
)


def _seconds(value: Any, place: str) -> None:
    """A decimal number as a string."""
    if not (isinstance(value, str) and len(value) <= 30 and value.isascii() and value.replace(".", "", 1).isdigit()):
        raise wrong(place, value, "a number of seconds")


def _json(shape: Shape) -> Shape:
    """JSON of a shape, as a string."""

    def check(value: Any, place: str) -> None:
        shape(parse_json(value, place), place)

    return check


#: Items of the session metadata; the configuration is checked where it is used.
_SESSION: Mapping[str, Shape] = {
    layout.PART_KEY: digits,
    layout.SNAPSHOT_KEY: _seconds,
    layout.INCLUDE_KEY: _json(list_of(text)),
    layout.EXCLUDE_KEY: _json(list_of(text)),
    layout.CUSTOM_KEY: _json(map_of(text)),
    "slice_start_ns": digits,
    "slice_end_ns": digits,
    "slice_streams": _json(list_of(text)),
    "sequence_epoch_ns": digits,
    "stamps_corrected": _json(list_of(anything)),
    "sequence_header": _json(map_of(anything)),
}
_SLICE = ("slice_start_ns", "slice_end_ns")


def check_session(items: Mapping[str, str], place: str) -> None:
    """Raise DamagedRecording (or LimitExceeded) with the item that has not the expected shape."""
    for key, shape in _SESSION.items():
        if key in items:
            shape(items[key], f"{place}: session: {key}")
    for key in _SLICE if "slice_of" in items else ():
        if key not in items:
            raise DamagedRecording(f"{place}: session: found no item {key!r}, expected one beside 'slice_of'")


def usable_session(items: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """The items that can be used, and the names of the others with the reason."""
    unusable: dict[str, str] = {}
    for key, shape in _SESSION.items():
        if key in items:
            try:
                shape(items[key], key)
            except DamagedRecording as error:
                unusable[key] = str(error)
    if why := configuration_fault(items.get(layout.CONFIGURATION_KEY, "{}")):
        unusable[layout.CONFIGURATION_KEY] = why
    if "slice_of" in items and (lacking := [key for key in _SLICE if key not in items or key in unusable]):
        unusable["slice_of"] = f"found no usable item {lacking[0]!r}, expected one beside it"
    return {key: value for key, value in items.items() if key not in unusable}, unusable


def configuration_fault(written: str) -> str:
    """Why a recorded configuration cannot be used; ``""`` if it can."""
    from igtl_gateway.config.configuration import (
        Config,
    )  # here: a process that only writes does not load all conversions

    try:
        Config.from_dict(configuration({layout.CONFIGURATION_KEY: written}))
    except (ConfigError, DamagedRecording) as error:
        return str(error)
    return ""


def ledger(written: str, place: str) -> dict[str, Any]:
    """The ledger of its JSON.  Raises DamagedRecording, or LimitExceeded."""
    found = parse_json(written, f"{place}: ledger")
    _LEDGER(found, "ledger" if not place else f"{place}: ledger")
    return dict(found)


def configuration(items: Mapping[str, str]) -> dict[str, Any]:
    """The configuration in the session metadata, empty where there is none.  Raises DamagedRecording."""
    place = "session: config"
    found = parse_json(items.get(layout.CONFIGURATION_KEY, "{}"), place)
    map_of(anything)(found, place)
    return dict(found)
