"""Charts of a report: an XML parser reads them, lengths are proportional, and foreign text stays text."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.cohort import charts
from tests.tables import table

_text = st.text(max_size=60) | st.sampled_from(["<script>alert(1)</script>", "a&b", "\x00\x1b[31m", '"', "\n" * 5])


def texts(root: ElementTree.Element, kind: str) -> list[str]:
    return [(each.text or "") for each in root.iter(kind)]


def lengths(page: str, side: str) -> list[float]:
    """The lengths of what is drawn, in the order of the page."""
    return [float(each) for each in re.findall(rf'<i style="{side}:([0-9.]+)%">', page)]


@given(_text)
def test_foreign_text_is_one_line_of_text(value: str) -> None:
    (root,) = (ElementTree.fromstring(f'<a b="{charts.text(value)}">{charts.text(value)}</a>'),)
    assert root.text == root.attrib["b"] or not root.text
    assert not any(sign in (root.text or "") for sign in "\n\r\x00\x1b")
    assert not list(root), "no element comes from a value"


def test_long_text_is_cut() -> None:
    assert charts.text("x" * 300) == "x" * 300
    assert charts.text("x" * 301) == "x" * 299 + "…"
    assert charts.text("&" * 50, 40) == "&amp;" * 39 + "…", "it is cut before it is escaped"


@given(st.lists(st.tuples(_text, st.floats(0, 1e6), _text), max_size=5))
def test_bars_are_as_long_as_their_values(rows: list[tuple[str, float, str]]) -> None:
    page = charts.bars(rows)
    values = [length for _, length, _ in rows]
    if len(set(values)) < 2:
        assert page == "", "nothing to compare"
        return
    ElementTree.fromstring(page)
    drawn = [length for length in values if length]
    found = lengths(page, "width")
    assert len(found) == len(drawn), "what is zero has no bar"
    for width, length in zip(found, drawn, strict=True):
        assert width == pytest.approx(70 * length / max(values), abs=0.06)
    assert page.count("<span title=") == len(rows)


@table(
    ("values", "widths"),
    [
        ([-5, 10], [70.0]),
        ([0, 0, 0], []),
        ([3, 3], []),
        ([7], []),
        ([], []),
        ([0, 1e-9], [70.0]),
    ],
)
def test_what_cannot_be_compared_has_no_bars(values: list[float], widths: list[float]) -> None:
    page = charts.bars([(str(number), value, "x") for number, value in enumerate(values)])
    assert lengths(page, "width") == widths
    assert bool(page) == bool(widths)


def test_columns_show_how_many_of_each_class_are_marked() -> None:
    page = charts.shares([("0-1", 10, 5), ("1-2", 20, 0), ("2-3", 0, 0)], "distance, mm")
    root = ElementTree.fromstring(f"<a>{page}</a>")
    assert re.findall(r'class="column" style="height:([0-9.]+)px"', page) == ["90.0", "180.0", "0.0"]
    assert lengths(page, "height") == [50.0]
    words = [(each.text, column.tail) for each in root[0] for column in each]
    assert words == [("50%", "0-1"), ("0%", "1-2"), (None, "2-3")]
    assert texts(root, "p") == ["distance, mm"]
    assert charts.shares([("a", 0, 0)], "b") == "" == charts.shares([], "b")


def test_cells_of_tables() -> None:
    root = ElementTree.fromstring(charts.table(["a", "<b>"], [[1, None], ["x<y", 2.5]], ["<b>"], ["a"]))
    assert texts(root, "th") == ["a", "<b>"]
    assert [[cell.text for cell in row.iter("td")] for row in root.iter("tr")] == [[], ["1", None], ["x<y", "2.5"]]
    assert [cell.get("class") for cell in root.iter("td")] == ["long", "number"] * 2
