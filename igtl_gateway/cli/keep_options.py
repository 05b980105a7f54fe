"""The options of ``igtl-gateway keep``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.config.setting import Setting, grouped
from igtl_gateway.config.settings import BY_SETTING

_OF_RETENTION: dict[str, Any] = {"needs": ("retention",), "group": "retention"}
OPTIONS = (
    Setting("json", False, "print the result as one JSON object, of each of the two"),
    replace(
        BY_SETTING["retention"],
        about="delete by age (h, d, w), by size of all (MB, GB, TB, MiB, GiB, TiB) or by both, such as '30 d, 200 GB'",
        needs=(),
        group="retention",
    ),
    Setting("dry_run", False, "print what would be deleted, and delete nothing", **_OF_RETENTION),
    Setting("only_sealed", False, "keep recordings that are not sealed to their end", **_OF_RETENTION),
    Setting("only_uploaded", False, "keep recordings that no store has confirmed", **_OF_RETENTION),
    Setting(
        "trust_clock",
        False,
        "delete by age although the clock is ahead of the last run by more than the age",
        **_OF_RETENTION,
    ),
)


def keep_options() -> tuple[Setting, ...]:
    """The options, with those of the upload if it is there."""
    more: tuple[Setting, ...] = part_of("upload", "settings:KEEPING") if is_present("upload") else ()
    return (*OPTIONS, *grouped("upload", *more))
