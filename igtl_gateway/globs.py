"""Globs of topics and streams."""

from __future__ import annotations

import re
from functools import lru_cache


@lru_cache(maxsize=1024)
def _pattern(glob: str) -> re.Pattern[str]:
    parts = (re.escape(part).replace(r"\*", "[^/]*").replace(r"\?", "[^/]") for part in glob.split("**"))
    return re.compile(".*".join(parts), re.DOTALL)


def matches(glob: str, name: str) -> bool:
    """Return whether ``name`` matches ``glob``: ``*`` and ``?`` within one level, ``**`` across levels."""
    return _pattern(glob).fullmatch(name) is not None
