"""``igtl-gateway sync`` of a folder: the lags of each recording in and below it, one table, a row for each pair.

A recording that gives no lag, or that cannot be read, is a row with its verdict; the others go on.  One is read at a
time.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.reading import SessionFile
from igtl_gateway.addon.terminal import (
    aligned,
    clear_live_line,
    count_text,
    is_terminal,
    live_line,
    print_json,
    print_line,
)
from igtl_gateway.addon.untrusted import check_limit
from igtl_gateway.addon.writing import SIDE_FILE, is_unfinished
from igtl_gateway.addons.sync.lag import Lag
from igtl_gateway.addons.sync.signal import Signal

#: Verdict of a recording, or of a stream of it, that cannot be read, and of one without two streams that could move.
UNREADABLE, NOTHING = "unreadable", "no_pair"
#: What follows in the error about a stream that a recording does not have, with the command that lists its streams.
_COMMAND = ", expected a recorded stream"
#: The lags of a recording: the reference, the others, and the streams that cannot be read with the reason.
Measured = tuple[Signal, Sequence[tuple[Signal, Lag]], Mapping[str, str]]
#: Measures the lags of the recording at a path.
Measure = Callable[[Path], Measured]
#: Makes JSON of a lag.
Facts = Callable[[Signal, Lag], dict[str, Any]]


def recordings_of(folder: Path) -> list[Path] | None:
    """Return the recordings in and below a folder, by name; None if it is one recording, or has none.

    Raises LimitExceeded for too many.
    """
    if not folder.is_dir() or _is_recording(folder):
        return None
    found = list(_found(folder))
    return sorted(found) or None


def _is_recording(folder: Path) -> bool:
    """Return whether a folder is a split recording: it has the side file of one, or opens as one."""
    if (folder / SIDE_FILE).exists():
        return True
    try:
        with SessionFile.open(folder, incomplete=True):
            return True
    except GatewayError:
        return False


def _found(folder: Path) -> Iterator[Path]:
    count = 0
    for place, folders, names in os.walk(folder):
        if SIDE_FILE in names:  # one recording, or a bag
            folders.clear()
            files = [Path(place)]
        else:
            files = [Path(place, name) for name in names if name.endswith(".mcap")]
        for path in files:
            if not is_unfinished(path):
                count += 1
                check_limit("count", count, f"{folder}: recordings")
                yield path


def run_folder(folder: Path, recordings: Sequence[Path], measure: Measure, facts: Facts, *, as_json: bool) -> int:
    """Measure the lags of recordings and print them; return the exit code, 0 if each row has a lag."""
    rows: list[dict[str, Any]] = []
    shows = is_terminal() and not as_json
    for number, path in enumerate(recordings, 1):
        if shows:
            live_line(f"{number:,} of {len(recordings):,}: {path.relative_to(folder)}", error=True)
        rows += _rows(path, str(path.relative_to(folder)), measure, facts)
    if shows:
        clear_live_line(error=True)
    good = all(row["verdict"] in ("measured", "varies") for row in rows)
    if as_json:
        print_json({"folder": str(folder), "recordings": len(recordings), "good": good, "lags": rows})
    else:
        _print(folder, len(recordings), rows)
    return 0 if good else 1


def _rows(path: Path, name: str, measure: Measure, facts: Facts) -> Iterator[dict[str, Any]]:
    try:
        fixed, lags, unreadable = measure(path)
    except (GatewayError, OSError) as error:
        # a recording that is read and has no such streams is no damage
        verdict = NOTHING if type(error) in (GatewayError, ConfigError) else UNREADABLE
        text = str(error.strerror or error) if isinstance(error, OSError) else str(error)
        yield _row(name, "", "", verdict, text.removeprefix(f"{path}: ").partition(_COMMAND)[0])
        return
    for signal, lag in lags:
        yield {"recording": name, "fixed": fixed.name, **facts(signal, lag)}
    for key, why in unreadable.items():
        yield _row(name, fixed.name, key, UNREADABLE, why)


def _row(name: str, fixed: str, stream: str, verdict: str, reason: str) -> dict[str, Any]:
    return {"recording": name, "fixed": fixed, "stream": stream, "verdict": verdict, "reason": reason}


def _print(folder: Path, count: int, rows: Sequence[Mapping[str, Any]]) -> None:
    references = {row["fixed"] for row in rows} - {""}
    is_one = len(references) == 1
    if is_one:
        print_line(f"behind {next(iter(references))}:")
    titles = ("recording", *(() if is_one else ("behind",)), "stream", "verdict", "lag", "95 %", "")
    table = [titles, *(_cells(row, is_one) for row in rows)]
    print_line(*aligned(table, left=3 if is_one else 4, text=True))
    verdicts = Counter(row["verdict"] for row in rows)
    told = ", ".join(f"{number:,} {verdict}" for verdict, number in sorted(verdicts.items()))
    print_line(f"{folder}: {count_text(count, 'recording')}, {count_text(len(rows), 'row')}: {told}")


def _cells(row: Mapping[str, Any], is_one: bool) -> tuple[str, ...]:
    numbers = ("", "")
    has_lag = row["verdict"] in ("measured", "varies")
    if has_lag:
        lag, low, high = (1e3 * row[name] for name in ("lag_s", "low_s", "high_s"))
        numbers = (f"{lag:+.1f} ms", f"{low:+.1f} to {high:+.1f}")
    behind = () if is_one else (row["fixed"],)
    return (row["recording"], *behind, row["stream"], row["verdict"], *numbers, "" if has_lag else row["reason"])
