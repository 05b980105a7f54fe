"""One of a thing is no plural: sentences with counts are made by ``count_text``.

Strategy: the sources of what people read have no count in front of a plural of the usual nouns; those that are never 1
are listed.
"""

from __future__ import annotations

import re
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "igtl_gateway"
#: A value of an f-string, by a name in lower case, and a plural behind it.
_COUNT = re.compile(r"\{[a-z_][\w.]*(?:\([\w., ]*\))?(?::,)?\} (?:messages|files|streams|links|parts|outputs|inputs)\b")
#: Beginnings of lines that are never about one.
_MANY = ('return f"<',)
FOLDERS = ("doctor", "cli", "app", "replay")


def test_no_count_stands_before_a_plural() -> None:
    found = [
        f"{path.relative_to(PACKAGE)}:{number}: {line.strip()}"
        for folder in FOLDERS
        for path in sorted((PACKAGE / folder).rglob("*.py"))
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
        if _COUNT.search(line) and not line.strip().startswith(_MANY)
    ]
    assert found == []
