"""Every word of the loss ledger has its place in the list of fates, and words for people."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module

import pytest

from igtl_gateway.base.errors import ConversionError, WireError
from igtl_gateway.cli.losses import losses, reason_text
from igtl_gateway.convert.profiles import PROFILES
from igtl_gateway.gateway.log.fates import DROPPED, KEPT, NOT_FOR, REFUSED_COMMANDS
from igtl_gateway.gateway.log.ledger import Ledger, gaps
from tests.places import PACKAGE

REASONS = {*DROPPED, *REFUSED_COMMANDS}


def fates_in(tree: ast.Module) -> Iterator[ast.expr]:
    """What a module gives to the ledger: fates of outcomes, reasons of losses."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name("Outcome"), args=[_, fate, *_]):
                yield fate
            case ast.Call(func=ast.Attribute(attr="drop"), args=[_, _, reason, *_]):
                yield reason
            case ast.keyword(arg="fate", value=fate):
                yield fate
            case ast.keyword(arg="loss", value=ast.Tuple(elts=[_, reason])):
                yield reason
            case ast.Assign(targets=[ast.Name("loss")], value=ast.Tuple(elts=[_, reason])):
                yield reason


def test_every_fate_of_the_code_is_in_the_list() -> None:
    found = set()
    for path in (PACKAGE / "gateway").rglob("*.py"):
        names = vars(import_module(".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)))
        for expression in fates_in(ast.parse(path.read_text("utf-8"))):
            parts = (expression.body, expression.orelse) if isinstance(expression, ast.IfExp) else (expression,)
            found |= {part.value for part in parts if isinstance(part, ast.Constant)}
            found |= {names[part.id] for part in parts if isinstance(part, ast.Name) and part.id.isupper()}
    wire: list[type[WireError]] = [WireError, *WireError.__subclasses__()]
    conversion: list[type[ConversionError]] = [ConversionError, *ConversionError.__subclasses__()]
    found |= {error.code for error in wire} | {error.code for error in conversion}
    assert {"probed", "not_wanted", "conversion"} <= found
    assert found - {*KEPT, *REASONS} == set()
    assert not KEPT.keys() & REASONS


@pytest.mark.parametrize("fate", [*KEPT, *sorted(REASONS)])
def test_the_ledger_closes_with_every_fate(fate: str) -> None:
    ledger = Ledger()
    ledger.count("igtl_in", "STATUS/a", "received")
    (ledger.count if fate in KEPT else ledger.drop)("igtl_in", "STATUS/a", fate)
    told = {"streams": ledger.to_dict()}
    assert gaps(told) == []
    lines = losses(told)
    assert lines == ([] if fate in KEPT else [f"      1  OpenIGTLink in STATUS/a: {reason_text(fate)}"])


def test_every_reason_has_words() -> None:
    for reason in (*REASONS, *(f"{NOT_FOR}{profile.name}" for profile in PROFILES)):
        assert " " in reason_text(reason), reason
    assert reason_text("of_a_later_version") == "of_a_later_version"


def test_losses_at_the_edges_are_told() -> None:
    """Of video, and of messages that DDS lost: no entry shows them."""
    counts = {"received": 9, "done": 4, "dropped": {"refused": 3, "queue_full": 2}, "changed": {"padded_to_even": 4}}
    told = {"ros_topics": {"/scan": {"lost": 7}, "/tf": {"lost": 0}}, "video": {"encoder": {"/depth": counts}}}
    assert losses(told) == [
        "      7  ROS in /scan: lost before the bridge received them",
        "      3  encoder /depth: not encoded: see the note video_refused",
        "      2  encoder /depth: faster than its codec",
        "      4  encoder /depth: encoded with a repeated last column or row: its size was odd",
    ]
