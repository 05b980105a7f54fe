"""The classes of the native passage: each is freed as often as it is made, and has no more references than objects."""

from __future__ import annotations

import gc
import socket
import sys
from collections.abc import Callable
from typing import Any

import pytest

from igtl_gateway.native.passage import Guard, Link, Lock, Passage, Publisher, Subscription, is_compiled
from tests.tables import table

pytestmark = pytest.mark.skipif(not is_compiled(), reason="without the native passage")


def _link() -> Any:
    with socket.socket() as one:
        return Link(Passage(), 1, one.fileno(), Lock())


MADE: dict[str, Callable[[], Any]] = {
    "Guard": Guard,
    "Link": _link,
    "Lock": Lock,
    "Passage": Passage,
    "Publisher": lambda: Publisher(0, True),
    "Subscription": lambda: Subscription(Passage(), 0),
}


@pytest.fixture(autouse=True)
def few_objects() -> None:
    """Leave what other tests have made out of the collections."""
    gc.freeze()


@table("name", list(MADE))
def test_an_object_leaves_its_class(name: str) -> None:
    made = MADE[name]
    kind = type(made())
    gc.collect()
    before = sys.getrefcount(kind)
    objects = [made() for _ in range(50)]
    assert sys.getrefcount(kind) == before + 50, "a class that is made when the module is loaded counts its objects"
    objects.clear()
    gc.collect()
    assert sys.getrefcount(kind) == before


@table("name", [*MADE, "Stream"])
def test_a_class_is_of_its_module_and_cannot_be_changed(name: str) -> None:
    kind = getattr(sys.modules["igtl_gateway.native._passage"], name)
    assert (kind.__module__, kind.__name__) == ("igtl_gateway.native._passage", name)
    with pytest.raises(TypeError, match="immutable"):
        kind.anything = 1
