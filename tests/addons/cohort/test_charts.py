"""Charts of a report: an XML parser reads them, lengths are proportional, and foreign text stays text."""

from __future__ import annotations

from itertools import pairwise
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.cohort import charts

_text = st.text(max_size=60) | st.sampled_from(["<script>alert(1)</script>", "a&b", "\x00\x1b[31m", '"', "\n" * 5])


def texts(root: ElementTree.Element, kind: str) -> list[str]:
    return [(each.text or "") for each in root.iter(kind)]


def rectangles(root: ElementTree.Element) -> list[dict[str, float]]:
    return [{key: float(value) for key, value in each.attrib.items() if key != "class"} for each in root.iter("rect")]


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
    root = ElementTree.fromstring(charts.bars(rows))
    found = rectangles(root)
    assert len(found) == len(rows)
    largest = max((length for _, length, _ in rows), default=0.0) or 1.0
    for number, (rect, (_, length, _)) in enumerate(zip(found, rows, strict=True)):
        assert rect["width"] == pytest.approx(380 * length / largest, abs=0.06)
        assert rect["y"] == 22 * number + 3 and rect["x"] == 260
    assert len(texts(root, "title")) == len(rows)


def test_a_bar_of_less_than_nothing_has_no_length() -> None:
    assert [
        rect["width"] for rect in rectangles(ElementTree.fromstring(charts.bars([("a", -5, ""), ("b", 10, "")])))
    ] == [
        0.0,
        380.0,
    ]
    assert ElementTree.fromstring(charts.bars([])).attrib["viewBox"] == "0 0 770 0"


def test_columns_show_how_many_of_each_class_are_marked() -> None:
    root = ElementTree.fromstring(charts.shares([("0-1", 10, 5), ("1-2", 20, 0), ("2-3", 0, 0)], "distance, mm"))
    heights = [rect["height"] for rect in rectangles(root)]
    assert heights == [90.0, 45.0, 180.0, 0.0, 0.0, 0.0]
    assert [each.attrib.get("class") for each in root.iter("rect")] == [None, "marked"] * 3
    for rect in rectangles(root):
        assert rect["y"] + rect["height"] == pytest.approx(200), "they stand on one line"
    assert texts(root, "text") == ["50%", "0-1", "0%", "1-2", "", "2-3", "distance, mm"]


def test_columns_have_room_beside_each_other() -> None:
    for count in (1, 2, 7):
        found = rectangles(ElementTree.fromstring(charts.shares([("a", 1, 1)] * count, "b")))[::2]
        edges = [(rect["x"], rect["x"] + rect["width"]) for rect in found]
        assert all(left < right for left, right in edges)
        assert all(before[1] < after[0] for before, after in pairwise(edges))
        assert edges[0][0] > 0 and edges[-1][1] < 770
    assert rectangles(ElementTree.fromstring(charts.shares([], "b"))) == []


def test_cells_of_tables() -> None:
    root = ElementTree.fromstring(charts.table(["a", "<b>"], [[1, None], ["x<y", 2.5]]))
    assert texts(root, "th") == ["a", "<b>"]
    assert [[cell.text for cell in row.iter("td")] for row in root.iter("tr")] == [[], ["1", None], ["x<y", "2.5"]]
