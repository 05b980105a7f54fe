"""The columns of the tables, with types and meanings; without the libraries that read and write them.

SQL takes all names without quotes.  A change of a column's name, type or meaning makes a new ``SCHEMA_VERSION``.
All lengths are in the unit that the name ends with; times are UTC.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SCHEMA_VERSION = 2
#: Columns of version 1 whose names are reserved words of SQL → their names now.
RENAMED = {"foreign": "is_foreign", "end": "end_time"}

Row = dict[str, Any]

#: The first columns of every table: the task that made the row, and the file, as a path or URL.
_EACH = {"task": "text", "file": "text"}
_END = {
    "distance_mm": "real",
    "error_mm": "real",
    "noise_mm": "real",
    "reading_mm": "real",
    "density_mm2": "real",
    "missing": "real",
    "executed_mm": "real",
}

#: Table → column → type.
TABLES: Mapping[str, Mapping[str, str]] = {
    "tasks": {
        **_EACH,
        "verb": "text",
        "status": "text",
        "error": "text",
        "bytes": "int",
        "mark": "text",
        "content": "text",
        "settings": "text",
        "version": "text",
        "requests": "int",
        "bytes_read": "int",
        "seconds": "real",
    },
    "recordings": {
        **_EACH,
        "start": "time",
        "duration_s": "real",
        "entries": "int",
        "streams": "int",
        "format_version": "int",
        "is_foreign": "truth",
        "recorded_by": "text",
        "scenario": "text",
        "imported": "text",
        "part": "int",
        "links": "int",
        "notes": "int",
        "lost": "int",
        "has_ledger": "truth",
        "skipped": "int",
    },
    "streams": {
        **_EACH,
        "direction": "text",
        "stream": "text",
        "topic": "text",
        "type": "text",
        "messages": "int",
        "first": "time",
        "last": "time",
        "rate_hz": "real",
    },
    "verifications": {
        **_EACH,
        "good": "truth",
        "recorded_by": "text",
        "inputs": "int",
        "outputs": "int",
        "equal": "int",
        "differing": "int",
        "lost": "int",
        "missing": "int",
        "orphans": "int",
        "late": "int",
        "first_difference": "text",
    },
    "findings": {
        **_EACH,
        "rule": "text",
        "severity": "text",
        "title": "text",
        "place": "text",
        "text": "text",
    },
    "latencies": {
        **_EACH,
        "link": "int",
        "peer": "text",
        "host": "text",
        "stream": "text",
        "messages": "int",
        "unstamped": "int",
        "median_ms": "real",
        "least_ms": "real",
        "jitter_ms": "real",
        "spread_ms": "real",
        "drift_ppm": "real",
        "future": "int",
        "backwards": "int",
    },
    "marks": {
        **_EACH,
        "label": "text",
        "text": "text",
        "who": "text",
        "time": "time",
        "end_time": "time",
        "is_open": "truth",
    },
    "reviews": {
        **_EACH,
        "plans": "int",
        "stitches": "int",
        "wrong_first": "int",
        "wrong_last": "int",
        "corrected": "int",
        "noise_mm": "real",
        "cloud": "text",
        "clouds": "int",
        "tool": "text",
    },
    "stitches": {
        **_EACH,
        "plan": "int",
        "is_first": "truth",
        "is_last": "truth",
        "topic": "text",
        "time": "time",
        "number": "int",
        "label": "text",
        "level": "text",
        "reasons": "text",
        "corrected": "truth",
        "moved_mm": "real",
        "bite_length_mm": "real",
        "bite_depth_mm": "real",
        "driven_depth_mm": "real",
        **{f"entry_{name}": kind for name, kind in _END.items()},
        **{f"exit_{name}": kind for name, kind in _END.items()},
    },
    "lags": {
        **_EACH,
        "fixed": "text",
        "stream": "text",
        "verdict": "text",
        "has_lag": "truth",
        "lag_ms": "real",
        "low_ms": "real",
        "high_ms": "real",
        "r2": "real",
        "skew_ppm": "real",
        "samples": "int",
        "common_s": "real",
        "reason": "text",
    },
}
