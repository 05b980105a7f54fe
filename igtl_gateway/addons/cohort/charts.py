"""Charts of a report as inline SVG: bars with names, and shares over classes.  All text is escaped."""

from __future__ import annotations

import html
from collections.abc import Sequence

from igtl_gateway.addon.untrusted import printable

_ROW, _NAME, _BAR, _VALUE = 22, 260, 380, 130
_LONGEST = 40
_HEIGHT, _FOOT, _HEAD = 180, 44, 20


def text(value: object, most: int = 300) -> str:
    """Return foreign text for a page: one line, without control characters, escaped, and cut."""
    line = printable(str(value))
    return html.escape(line if len(line) <= most else f"{line[: most - 1]}…", quote=True)


def bars(rows: Sequence[tuple[str, float, str]]) -> str:
    """Return horizontal bars.

    Args:
        rows: name, length (0 or more), and what stands behind the bar.
    """
    largest = max((length for _, length, _ in rows), default=0.0) or 1.0
    height = _ROW * len(rows)
    parts = [f'<svg viewBox="0 0 {_NAME + _BAR + _VALUE} {height}" role="img">']
    for number, (name, length, value) in enumerate(rows):
        top = _ROW * number
        wide = _BAR * max(0.0, length) / largest
        parts += [
            f'<text x="{_NAME - 8}" y="{top + 15}" text-anchor="end">{text(name, _LONGEST)}'
            f"<title>{text(name)}</title></text>",
            f'<rect x="{_NAME}" y="{top + 3}" width="{wide:.1f}" height="{_ROW - 6}"/>',
            f'<text x="{_NAME + wide + 6:.1f}" y="{top + 15}">{text(value)}</text>',
        ]
    return "".join([*parts, "</svg>"])


def shares(classes: Sequence[tuple[str, int, int]], axis: str) -> str:
    """Return columns: how many there are of each class, and how many of these are marked.

    Args:
        classes: name, number, and number of the marked ones.
        axis: what the classes are of, with the unit.
    """
    largest = max((number for _, number, _ in classes), default=0) or 1
    wide = (_NAME + _BAR + _VALUE) / max(1, len(classes))
    full = _HEAD + _HEIGHT + _FOOT
    parts = [f'<svg viewBox="0 0 {_NAME + _BAR + _VALUE} {full}" role="img">']
    for place, (name, number, marked) in enumerate(classes):
        left, middle = place * wide, (place + 0.5) * wide
        for kind, count in (("", number), (' class="marked"', marked)):
            high = _HEIGHT * count / largest
            parts.append(
                f'<rect{kind} x="{left + 4:.1f}" y="{_HEAD + _HEIGHT - high:.1f}" width="{wide - 8:.1f}" '
                f'height="{high:.1f}"/>'
            )
        share = f"{marked / number:.0%}" if number else ""
        top = _HEAD + _HEIGHT * (1 - number / largest) - 5
        parts += [
            f'<text x="{middle:.1f}" y="{top:.1f}" text-anchor="middle">{share}</text>',
            f'<text x="{middle:.1f}" y="{_HEAD + _HEIGHT + 16}" text-anchor="middle">{text(name)}</text>',
        ]
    middle = (_NAME + _BAR + _VALUE) / 2
    parts.append(f'<text x="{middle:.1f}" y="{full - 8}" text-anchor="middle">{text(axis)}</text>')
    return "".join([*parts, "</svg>"])


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table; None is an empty cell."""
    head = "".join(f"<th>{text(each)}</th>" for each in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{'' if cell is None else text(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"
