"""Parsed definitions of types: impossible ones are refused with their place, and sizes are counted before any code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from rosbags.interfaces import Nodetype

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.definition_checks import LONGEST_NAME, TYPE, check_types, weight
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from tests.tables import table

Description = tuple[Nodetype, Any]


def base(name: str, bound: int = 0) -> Description:
    return Nodetype.BASE, (name, bound)


def name(ros_type: str) -> Description:
    return Nodetype.NAME, ros_type


def array(each: Description, size: int) -> Description:
    return Nodetype.ARRAY, (each, size)


def sequence(each: Description, bound: int = 0) -> Description:
    return Nodetype.SEQUENCE, (each, bound)


A = "p/msg/A"
NUMBER, STRING = base("float64"), base("string")


def check(
    *fields: tuple[str, Description], constants: tuple[Any, ...] = (), others: Mapping[str, list[Any]] | None = None
) -> None:
    """Check the type A, with others of the package."""
    check_types(
        {A: (list(constants), list(fields))} | {f"p/msg/{key}": ([], rows) for key, rows in (others or {}).items()}, "d"
    )


def test_what_is_possible() -> None:
    check()
    check(("x", NUMBER), ("y", array(STRING, 1)), ("z", sequence(name("q/msg/Unknown"), 5)))
    check(
        ("x", name("p/msg/B")),
        ("y", name("p/msg/B")),
        constants=(("C", "int64", -(2**63)),),
        others={"B": [("v", NUMBER)]},
    )
    check(("text", base("string", 2**64 - 1)), constants=(("C", "string", "x" * 1000), ("D", "float64", 1.5)))


@table(
    ("ros_type", "valid"),
    [
        ("p/msg/A", True), ("p/A", True), ("a/b/c/D", True), ("a/b/c/d/E", False), ("A", False), ("p//A", False),
        ("p/msg/_A", False), ("p/msg/A__b", False), ("p/msg/A_b", True), ("1p/msg/A", False), ("p/msg/A\n", False),
        ("p/msg/Ä", False), ("", False),
    ],
)  # fmt: skip
def test_names_of_types(ros_type: str, valid: bool) -> None:
    assert bool(TYPE.fullmatch(ros_type)) == valid
    if not valid:
        with pytest.raises(DamagedRecording, match=r"d: field x: found the type .*, expected package/msg/Name"):
            check(("x", name(ros_type)))
        with pytest.raises(DamagedRecording, match=r"d: found the type .*, expected package/msg/Name"):
            check_types({ros_type: ([], [])}, "d")


@table(
    ("fields", "constants", "text"),
    [
        ([("1x", NUMBER)], [], "d: found the field '1x', expected an identifier"),
        ([("x;y", NUMBER)], [], "found the field 'x;y'"),
        ([("x" * (LONGEST_NAME + 1), NUMBER)], [], f"found the field '{'x' * LONGEST_NAME}', expected an identifier"),
        ([], [("C D", "int8", 1)], "found the field 'C D'"),
        ([("x", NUMBER), ("x", STRING)], [], "found two fields with the same name in p/msg/A, expected distinct names"),
        ([("x", NUMBER)], [("x", "int8", 1)], "found two fields with the same name"),
        ([], [("C", "float64", float("inf"))], "d: constant C: found inf, expected a finite number"),
        ([], [("C", "float64", float("nan"))], "d: constant C: found nan"),
        ([], [("C", "int64", 2**64)], "d: constant C: found a number of 65 bits, expected at most 64"),
        ([("x", array(NUMBER, 0))], [], "d: field x: found 0 elements, expected a positive number"),
        ([("x", array(NUMBER, -1))], [], "d: field x: found -1 elements"),
        ([("x", sequence(NUMBER, -1))], [], "d: field x: found -1 elements"),
        ([("x", sequence(NUMBER, 2**64))], [], f"found {str(2**64)[:20]} elements"),
        ([("x", base("string", -1))], [], "d: field x: found a string of -1 characters, expected a positive number"),
        ([("x", sequence(base("string", 2**64)))], [], f"found a string of {str(2**64)[:20]} characters"),
        ([("x", array(name("p/B;"), 2))], [], "found the type 'p/B;'"),
    ],
)
def test_what_is_impossible(fields: list[Any], constants: list[Any], text: str) -> None:
    with pytest.raises(DamagedRecording) as error:
        check(*fields, constants=tuple(constants))
    assert text in str(error.value)


def test_the_longest_names_are_accepted() -> None:
    longest = "p/msg/" + "A" * (LONGEST_NAME - 6)
    check_types({longest: ([], [("x" * LONGEST_NAME, NUMBER)])}, "d")
    with pytest.raises(DamagedRecording, match="found the type"):
        check_types({longest + "A": ([], [])}, "d")


@table(
    ("fields", "found"),
    [
        ([], 1),
        ([("x", NUMBER)], 2),
        ([("x", array(NUMBER, 1000))], 2),  # numbers are read at once
        ([("x", array(STRING, 1000))], 1001),  # each has a line of code
        ([("x", array(base("wstring"), 7))], 8),
        ([("x", array(name("p/msg/B"), 5)), ("y", sequence(name("p/msg/B"), 5))], 7),
    ],
)
def test_the_size_of_the_code_of_a_type(fields: list[Any], found: int) -> None:
    assert weight(([], fields)) == found
    assert weight(([("C", "int8", 1)], fields)) == found + 1


@table(
    ("limit", "given", "fields", "text"),
    [
        ("fields", 3, [("x", array(STRING, 3))], "d: found 4, expected at most 3"),
        ("count", 9, [("x", array(STRING, 4)), ("y", array(name("p/msg/B"), 3))], "elements of one p/msg/A: found 10"),
        ("free", 79, [("x", array(NUMBER, 10))], "bytes of one p/msg/A: found 80"),
        ("free", 47, [("x", array(name("p/msg/B"), 3))], "bytes of one p/msg/A: found 48"),
        ("depth", 1, [("x", name("p/msg/B"))], "d: nesting: found 2, expected at most 1"),
        ("fields", 8, [(f"x{i}", name("p/msg/B")) for i in range(3)], "fields of p/msg/A and of all in it: found 9"),
    ],
)
def test_sizes_are_counted(limit: str, given: int, fields: list[Any], text: str) -> None:
    """B has two numbers; in each case one more is allowed."""
    others = {"B": [("u", NUMBER), ("v", NUMBER)]} if any("p/msg/B" in str(field) for field in fields) else {}
    more: dict[str, int] = {limit: given + 1}
    with limits_in_force(FileLimits(**more)):
        check(*fields, others=others)
    less: dict[str, int] = {limit: given}
    with limits_in_force(FileLimits(**less)), pytest.raises(LimitExceeded) as error:
        check(*fields, others=others)
    assert text in str(error.value)


def test_a_type_inside_itself() -> None:
    with pytest.raises(DamagedRecording, match="d: found p/msg/A inside itself, expected types without a cycle"):
        check(("x", sequence(name(A))))
    with pytest.raises(DamagedRecording, match="inside itself"):
        check(("x", name("p/msg/B")), others={"B": [("y", array(name(A), 2))]})
    check(("x", name("p/msg/B")), ("y", name("p/msg/B")), others={"B": []})


def test_a_type_that_is_used_often_is_looked_at_once() -> None:
    """Each of thirty types has two of the next: 2³⁰ without memory of them."""
    rows = {f"T{number}": [("x", name(f"p/msg/T{number + 1}"))] for number in range(60)}
    check(("x", name("p/msg/T0")), others=rows)
