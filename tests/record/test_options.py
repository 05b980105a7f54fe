"""Defaults that the documents promise, and the time in the name of a recording."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.record.options import RecordOptions, path_at
from tests.tables import table


def test_the_defaults_that_are_documented() -> None:
    options = RecordOptions()
    assert (options.flush_s, options.fsync, options.compression) == (0.5, "never", "lz4")
    assert (options.queue_bytes, options.queue_entries, options.snapshot_bytes) == (256 << 20, 200_000, 512 << 20)
    assert (options.file_mode, options.overwrite, options.stop_on_failure) == (0o600, False, False)


@table(
    "path, expected",
    [
        ("a.mcap", "a.mcap"),
        ("{time}.mcap", "20231114T221320Z.mcap"),
        ("{time}/x_{time}.mcap", "20231114T221320Z/x_20231114T221320Z.mcap"),
    ],
)
def test_the_time_of_the_start_is_utc_to_the_second(path: str, expected: str) -> None:
    assert path_at(Path(path), 1_700_000_000_999_999_999) == Path(expected)
