"""What a user can choose of a review: fields of dataclasses, each with the help of its option."""

from __future__ import annotations

from dataclasses import field, fields
from typing import Any, TypeVar

from igtl_gateway.addon import Setting

T = TypeVar("T")


def option(default: T, metavar: str, about: str, **more: Any) -> T:
    """A field with its default, the placeholder and the help of its option, and other columns of its row."""
    made: T = field(default=default, metadata={"metavar": metavar, "about": about, **more})
    return made


def limit(default: float, metavar: str, about: str) -> float:
    """A threshold: a number above 0; the help has what it is, and the reason of the default."""
    return option(default, metavar, about, least=0, open_ends=True)


def rows_of(kind: Any, group: str = "") -> tuple[Setting, ...]:
    """Return the options of a dataclass of such fields."""
    rows: list[Any] = list(fields(kind))
    return tuple(Setting(each.name, each.default, group=group, **each.metadata) for each in rows)
