"""Lines and tables that fit into a number of columns: functions of plain text, which has no control characters.

A line is broken at its spaces.  What has none, such as a path, stays in one piece and may be longer, and so does a
command of this program: where it does not fit, it goes on behind a backslash, so that what is copied still runs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

#: The last column of a table has its place beside the others from this many columns on; else it is below them.
_LEAST_TEXT = 24
#: A long name gives way to the columns behind it down to this width; then it stands on a line of its own.
_LEAST_NAME = 16
#: A line goes on below its text if that begins with two spaces behind a word that is no longer than this.
_LONGEST_KEY = 24
_HANG = 4
_MARK = re.compile(r" *[-*=?!] ")
_KEY = re.compile(rf" *\S.{{0,{_LONGEST_KEY}}}?  +(?=\S)")
#: A command: its verb, and the words behind it that are options, paths, numbers, in capital letters, or in front of an
#: option or the end.
_COMMAND = re.compile(
    r"igtl-gateway (?:cohort |seal )?[a-z]+"
    r"(?: (?:'[^']*'|\"[^\"]*\"|-\S+|[^\s']*[/.=:*]\S*|[A-Z_]+[;,)]?|[0-9]{1,18}[;,)]?|[^\s';,]+(?= -\S|$)))*(?=\s|$)"
)
#: A number and its unit, and what stands in backquotes, are on one line.
_TOGETHER = re.compile(r"[0-9] (?:ns|µs|ms|s|min|h|k?Hz|[kMGT]?B|[KMG]iB|mm|m|%|ppm)\b|`[^`]{,60}`")
_GLUE, _SPACE = "\0", "\1"
#: What is in quotes is one word.
_WORDS = re.compile(r"(?:'[^']*'|\"[^\"]*\"|[^\0'\"])+")


def wrapped(line: str, columns: int) -> list[str]:
    """Return a line as lines of at most this number of columns, those behind the first one indented; 0: as it is."""
    if not columns or len(line) <= columns:
        return [line]
    hang = _hang(line, columns)
    room = columns - hang
    glued = _COMMAND.sub(lambda found: found.group().replace(" ", _GLUE), line)
    glued = _TOGETHER.sub(lambda found: found.group().replace(" ", _SPACE), glued)
    lines, current = [], ""
    for gap, word in re.findall(r"( *)([^ ]+)", glued):
        pieces = _command_lines(word, room) if _GLUE in word else [word]
        for number, piece in enumerate(pieces):
            space = "" if number else gap
            if current.strip() and (number or len(current) + len(space) + len(piece) > columns):
                lines.append(current)
                current, space = " " * (hang + _HANG * (number > 0)), ""
            current += space + piece
    return [each.replace(_GLUE, " ").replace(_SPACE, " ") for each in (*lines, current)]


def _hang(line: str, columns: int) -> int:
    """Return where the second line of a long one begins: below the text behind a mark or a word, or indented."""
    indent = len(line) - len(line.lstrip(" "))
    for form in (_MARK, _KEY):
        if (found := form.match(line)) and found.end() <= columns // 2:
            return found.end()
    return min(indent + _HANG, columns // 2)


def _command_lines(command: str, room: int) -> list[str]:
    """Return a command whose spaces are glued as pieces, each but the last one with a backslash."""
    if len(command) <= room:
        return [command]
    first, *words = _WORDS.findall(command)
    pieces = [f"{first}{_GLUE}{words[0]}"]
    for word in words[1:]:
        if len(pieces[-1]) + 1 + len(word) + 2 > room - _HANG:
            pieces[-1] += f"{_GLUE}\\"
            pieces.append(word)
        else:
            pieces[-1] += f"{_GLUE}{word}"
    return pieces


def table(
    rows: Sequence[Sequence[str]], columns: int, *, left: int, indent: str, widest: int, text: bool = False
) -> list[str]:
    """Return the lines of a table.

    Columns that do not fit beside the others stand below them, in each row.

    Args:
        rows: cells, the first row being the titles; all rows have the same number of cells.
        columns: of the terminal; 0: no limit.
        left: this number of columns is aligned on the left, the others, which hold numbers, on the right.
        indent: what each line begins with.
        widest: columns that one cell may take; a longer one moves the rest of its row to the right.
        text: whether the last column has sentences, which are wrapped and on the left.
    """
    count = len(rows[0]) - text
    widths = [min(max(len(row[column]) for row in rows), widest) for column in range(count)]
    room = columns - len(indent) if columns else 1 << 30
    if count and sum(widths) + 2 * (count - 1) > room:
        behind = sum(width + 2 for width in widths[1:])
        widths[0] = min(widths[0], max(_LEAST_NAME, room - behind)) if behind < room else min(widths[0], room)
    groups = _groups(widths, room)
    lines: list[str] = []
    for row in rows:
        lines += _row(row, widths, groups, left, indent, room, text)
    return lines


def _groups(widths: Sequence[int], room: int) -> list[list[int]]:
    """Return the columns that stand on each line of a row; those behind the first line are indented."""
    groups: list[list[int]] = [[]]
    used = 0
    for column, width in enumerate(widths):
        if groups[-1] and used + 2 + width > room:
            groups.append([])
            used = _HANG
        used += width + 2 * bool(groups[-1])
        groups[-1].append(column)
    return groups


def _row(
    row: Sequence[str],
    widths: Sequence[int],
    groups: Sequence[Sequence[int]],
    left: int,
    indent: str,
    room: int,
    text: bool,
) -> Iterator[str]:
    lines: list[str] = []
    end = 0
    for number, group in enumerate(groups):
        line = " " * (_HANG * (number > 0))
        for place, column in enumerate(group):
            width = widths[column]
            shown = row[column].ljust(width) if column < left else row[column].rjust(width)
            if len(row[column]) > width and not place and len(group) > 1:
                lines.append(line + row[column])
                shown = " " * width
            line += ("  " if place else "") + shown
        lines.append(line)
        end = len(line)
    if text and row[-1]:
        beside = room - end - 2
        if len(row[-1]) <= beside or beside >= _LEAST_TEXT:
            first, *others = wrapped(row[-1], beside)
            lines[-1] += f"  {first}"
            lines += [f"{' ' * (end + 2)}{other.lstrip()}" for other in others]
        else:
            lines += [f"{' ' * _HANG}{line}" for line in wrapped(row[-1], room - _HANG)]
    return (f"{indent}{line}".rstrip() for line in lines if line.strip())
