"""Charts and tables of a report as HTML: bars with names, and shares over classes.  All text is escaped.

Lengths are percentages and text has the size of the page, so that a narrow window shows all of it.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Sequence

from igtl_gateway.addon.untrusted import printable

#: Styles of what this module writes; colours are variables of the page.
STYLE = """
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
td, th { text-align: left; padding: 3px 18px 3px 0; vertical-align: top; }
th { color: var(--soft); font-weight: 500; white-space: nowrap; border-bottom: 1px solid var(--rule); }
td { white-space: nowrap; }
td.long { white-space: normal; overflow-wrap: anywhere; min-width: 13rem; }
.number { text-align: right; }
.bars { display: grid; grid-template-columns: minmax(6rem, 16rem) 1fr; gap: 5px 12px; margin: 14px 0; font-size: 14px; }
.bars > span { overflow-wrap: anywhere; }
.bar { display: flex; align-items: center; gap: 8px; white-space: nowrap; }
.bar i { background: var(--bar); height: 14px; border-radius: 2px; min-width: 2px; }
.shares { display: flex; align-items: flex-end; gap: 2%; margin: 14px 0 4px; font-size: 13px; }
.shares > div { flex: 1; text-align: center; min-width: 0; }
.column { position: relative; background: var(--bar); }
.column i { position: absolute; left: 0; right: 0; bottom: 0; background: var(--marked); }
@media (max-width: 40rem) {
  td, th { padding-right: 10px; }
  th { white-space: normal; vertical-align: bottom; }
  td.long { min-width: 5.5rem; }
  .bars { grid-template-columns: minmax(6rem, 11rem) 1fr; }
}
.axis { text-align: center; color: var(--soft); font-size: 13px; margin: 0 0 14px; }
"""

_LONGEST = 80
_HIGHEST_PX = 180


def text(value: object, most: int = 300) -> str:
    """Return foreign text for a page: one line, without control characters, escaped, and cut."""
    line = printable(str(value))
    return html.escape(line if len(line) <= most else f"{line[: most - 1]}…", quote=True)


def bars(rows: Sequence[tuple[str, float, str]]) -> str:
    """Return horizontal bars; nothing where there is nothing to compare: fewer than two, or all equal.

    Args:
        rows: name, length (0 or more, and 0 where what stands behind the bar is zero), and what stands behind the bar.
    """
    lengths = [max(0.0, length) for _, length, _ in rows]
    if len(set(lengths)) < 2:
        return ""
    largest = max(lengths)
    parts = ['<div class="bars">']
    for (name, _, value), length in zip(rows, lengths, strict=True):
        drawn = f'<i style="width:{70 * length / largest:.1f}%"></i>' if length else ""
        parts.append(
            f'<span title="{text(name)}">{text(name, _LONGEST)}</span><span class="bar">{drawn}{text(value)}</span>'
        )
    return "".join([*parts, "</div>"])


def shares(classes: Sequence[tuple[str, int, int]], axis: str) -> str:
    """Return columns: how many there are of each class, and how many of these are marked; "" for none at all.

    Args:
        classes: name, number, and number of the marked ones.
        axis: what the classes are of, with the unit.
    """
    largest = max((number for _, number, _ in classes), default=0)
    if not largest:
        return ""
    parts = ['<div class="shares">']
    for name, number, marked in classes:
        share = f"{marked / number:.0%}" if number else ""
        inside = f'<i style="height:{100 * marked / number:.1f}%"></i>' if marked else ""
        high = _HIGHEST_PX * number / largest
        parts.append(
            f'<div title="{marked:,} of {number:,}">{share}'
            f'<div class="column" style="height:{high:.1f}px">{inside}</div>'
            f"{text(name)}</div>"
        )
    return "".join([*parts, f'</div><p class="axis">{text(axis)}</p>'])


def table(
    heads: Sequence[str],
    rows: Sequence[Sequence[object]],
    numbers: Collection[str] = (),
    long: Collection[str] = (),
) -> str:
    """Return a table; None is an empty cell.

    Args:
        heads: of the columns.
        rows: their cells.
        numbers: heads of columns with numbers, which stand at the right.
        long: heads of columns whose text may take several lines.
    """
    kinds = ["number" if head in numbers else "long" if head in long else "" for head in heads]
    attributes = [f' class="{kind}"' if kind else "" for kind in kinds]
    head = "".join(f"<th{kind}>{text(each)}</th>" for each, kind in zip(heads, attributes, strict=True))
    body = "".join(
        "<tr>"
        + "".join(
            f"<td{kind}>{'' if cell is None else text(cell)}</td>" for cell, kind in zip(row, attributes, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'
