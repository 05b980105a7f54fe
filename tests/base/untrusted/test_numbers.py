"""Integers of untrusted text and documents have bounds, in one place."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache

import pytest

from igtl_gateway.addons.zenoh.config import DOMAIN, domain_of
from igtl_gateway.base.errors import ConfigError, ConversionError, DamagedRecording
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.untrusted.numbers import MOST, check_numbers, whole_number
from igtl_gateway.base.untrusted.text import parse_json, parse_toml
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.faults import Faults
from igtl_gateway.config.notations import address, cpus
from igtl_gateway.convert.images import pixel_layout
from igtl_gateway.record.sessionfile.layout import parse_qos_yaml
from tests.places import ROOT
from tests.tables import table

PACKAGE = ROOT / "igtl_gateway"
#: More digits than Python converts.
LONG = "9" * 5_000
#: More than a float holds, and fewer than Python converts.
LARGE = "9" * 400


@pytest.mark.parametrize(
    ("text", "number"), [("0", 0), ("007", 7), (str(MOST), MOST), (str(MOST - 1), MOST - 1), ("1" * 19, int("1" * 19))]
)
def test_whole_numbers(text: str, number: int) -> None:
    assert whole_number(text) == number
    assert whole_number(text, number) == number
    assert number == 0 or whole_number(text, number - 1) is None


@table("text", ["", "-1", "+1", "1.0", "1_0", " 1", "1\n", "²", "١", "0x1", str(MOST + 1), LARGE, LONG, None, 5, b"5"])
def test_what_is_no_whole_number(text: object) -> None:
    assert whole_number(text) is None


@pytest.mark.parametrize("digits", [LARGE, LONG, f"-{LARGE}", f"-{LONG}"])
def test_documents(digits: str) -> None:
    with pytest.raises(DamagedRecording, match=r"a\.json: .*expected at most 1000 bits"):
        parse_json(f'{{"a": [1, {digits}]}}', "a.json")
    for line in (f"a = {digits}", f"a = [1, {digits}]", f"[t]\nb.c = {{ d = {digits} }}"):
        with pytest.raises(DamagedRecording, match=r"a\.toml: "):
            parse_toml(line.encode(), "a.toml")
    assert parse_json(f"[{10**300}, {1 << 64}, 1e999]", "") == [10**300, 1 << 64, float("inf")]
    assert parse_toml(b"a = [9223372036854775807, -9]", "") == {"a": [9223372036854775807, -9]}
    # of other notations than decimal digits, which Python converts at any length
    with pytest.raises(DamagedRecording, match=r"a\.toml: a: found a number of 1200 bits, expected at most 1000"):
        parse_toml(f"a = [0x{'f' * 300}]".encode(), "a.toml")
    check_numbers({"a": [True, "x", None, 1.5, {"b": -(10**300)}]}, "x")


@pytest.mark.parametrize("digits", [LARGE, LONG])
def test_fields_of_files_and_peers(digits: str) -> None:
    qos = parse_qos_yaml(f"- depth: {digits}\n  reliability: reliable\n  durability: volatile\n")
    assert qos == Qos()
    with pytest.raises(ConversionError, match="expected one of"):
        pixel_layout(f"8UC{digits}")
    for fault in (f"delay={digits}s", f"delay=0.{digits}ms", f"loss={digits}%", f"clock-step=1s@{digits}s"):
        with pytest.raises(ConfigError, match="expected a"):
            Faults.parse(fault)
    for text in (f"host:{digits}", "host:²", f":{digits}"):
        with pytest.raises(ConfigError, match="expected HOST:PORT"):
            address(text)
    with pytest.raises(ConfigError, match="expected CPUs"):
        cpus(f"1-{digits}")
    with pytest.raises(ConfigError, match="expected a number from 0"):
        domain_of({DOMAIN: digits})


def test_configurations() -> None:
    """JSON states what TOML cannot: integers beyond every float, and halves of characters."""
    for row in ({"workspace": [10**308 * 10] * 6}, {"joint_min": [-(10**400)]}):
        with pytest.raises(ConfigError, match="expected numbers such as"):
            Config.from_dict({"crtk": [row]})
    for values, place in (
        ({"base_frame": "\ud800"}, "gateway.base_frame"),
        ({"to_ros": [{"device": "a\ud800"}]}, r"to_ros\[0\].device"),
        ({"tf_out": [{"frames": ["a", "\udfff"]}]}, r"tf_out\[0\].frames"),
        ({"to_igtl": [{"topic": "/a", "metadata": {"k": "\ud800"}}]}, r"to_igtl\[0\].metadata"),
    ):
        with pytest.raises(ConfigError, match=f"{place}: found .*expected text that UTF-8 can encode"):
            Config.from_dict(values)
    # bytes of a peer that are not UTF-8 are accepted
    assert Config.from_dict({"base_frame": "a\udcff"}).base_frame == "a\udcff"


# -- no other module converts digits ----------------------------------------------------------------------------------

#: Module → what it checks without converting it, or converts although it is not bounded by ``whole_number``.
_DIGITS = {
    "addons/cohort/query.py": "the last character of a number that DuckDB printed",
    "convert/names.py": "the first character of a name",
    "addons/exchange/raster.py": "integers with a sign, of at most 18 digits",
    "addons/lerobot/checking.py": "a range of episodes",
    "config/notations.py": "an octal mode of at most 4 digits",
    "record/sessionfile/facts.py": "decimal numbers of at most 30 characters",
    "base/untrusted/numbers.py": "here",
}
#: Module → regular expressions with digits without end, whose group is not converted.
_ENDLESS = {
    "addons/cohort/loading.py": "the names of open files",
    "addons/cohort/report.py": "names, for their order",
    "addons/exchange/formats.py": "names of files",
    "convert/plus_signs.py": "names of frames",
    "doctor/host_facts.py": "globs of names of files",
    "addons/resim/processes.py": "a glob of names of files",
    "addons/zenoh/library.py": "lines of a library",
    "record/retention/upload_state.py": "names of files",
    "replay/compare.py": "behind the bits of an encoding",
    "addons/view/shots.py": "ports that a child prints",
    "addons/view/viewer.py": "ports that a child prints",
}


@cache
def _sources() -> dict[str, str]:
    return {path.relative_to(PACKAGE).as_posix(): path.read_text("utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


def _modules(text: str) -> Iterator[tuple[str, ast.Module]]:
    """The modules that have what matches a regular expression: to parse all of them takes two seconds."""
    return ((name, ast.parse(source)) for name, source in _sources().items() if re.search(text, source))


def test_only_one_module_checks_digits() -> None:
    found = {
        name
        for name, tree in _modules(r"\bis(?:digit|decimal|numeric)\b")
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr in {"isdigit", "isdecimal", "isnumeric"}
    }
    assert found <= _DIGITS.keys(), "use igtl_gateway.base.untrusted.numbers.whole_number"
    assert found >= _DIGITS.keys() - {"addons/lerobot/checking.py"}


def test_digits_in_regular_expressions_have_an_end() -> None:
    endless = re.compile(r"(?:\\d|\[0-9\])(?:[+*]|\{\d*,\})")
    found = {
        name
        for name, tree in _modules(r"d|0-9")
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and endless.search(node.value)
    }
    assert found == _ENDLESS.keys(), "bound the digits that int() or float() converts: {1,18}"


def test_digits_in_regular_expressions_are_those_of_ascii() -> None:
    """``\\d`` also matches the digits of other scripts, which ``int`` converts: a name that no other program has."""
    found = {
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in PACKAGE.rglob("*.py")
        if r"\d" in (text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("re.")
        for one in ast.walk(node)
        if isinstance(one, ast.Constant) and isinstance(one.value, str) and r"\d" in one.value
        if "re.ASCII" not in ast.unparse(node)
    }
    assert found == set(), "use [0-9], or re.ASCII"
