"""Options and configuration table of the scheduling."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest

from igtl_gateway.cli import realtime
from igtl_gateway.cli.realtime import realtime_options
from igtl_gateway.config import Config
from igtl_gateway.errors import ConfigError
from igtl_gateway.realtime import RealtimeOptions


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    realtime.add_arguments(parser)
    return parser.parse_args(words)


def test_options() -> None:
    assert realtime_options(parsed(), None) == RealtimeOptions()
    given = parsed("--realtime-priority", "5", "--lock-memory", "--cpu-affinity", "1,3-4")
    assert realtime_options(given, None) == RealtimeOptions(5, True, frozenset({1, 3, 4}))


def test_the_table_of_a_file_and_the_options_before_it(tmp_path: Path) -> None:
    path = tmp_path / "host.toml"
    words = realtime.__doc__ or ""
    path.write_text(re.sub("(?m)^    ", "", words[words.index("    [host]") : words.index("Each setting")]))
    assert realtime_options(parsed(), path) == RealtimeOptions(20, True, frozenset({2, 3}))
    given = parsed("--realtime-priority", "5", "--cpu-affinity", "1")
    assert realtime_options(given, path) == RealtimeOptions(5, True, frozenset({1}))
    assert Config.from_toml(path) == Config()
    assert {f"--{name.replace('_', '-')}" for name in re.findall(r"(?m)^(\w+) =", path.read_text())} == {
        "--realtime-priority",
        "--lock-memory",
        "--cpu-affinity",
    }


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("host = 1", "found host = 1, expected a table [host]"),
        ("[host]\nrealtime_priority = 100", "host.realtime_priority: found 100, expected 1 (lowest) to 99"),
        ("[host]\nrealtime_priority = 'high'", "host.realtime_priority: found 'high', expected an integer"),
        ("[host]\ncpu_affinity = 'all'", "host.cpu_affinity: found 'all', expected CPUs such as 2,4-6"),
        ("[host]\nnice = 1", "host.nice: unknown setting, expected one of realtime_priority"),
    ],
)
def test_invalid_settings_are_named_with_their_place(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "host.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        realtime_options(parsed(), path)
    assert str(error.value).startswith(f"{path}: {words}")


def test_invalid_options(capsys: pytest.CaptureFixture[str]) -> None:
    for number in ("0", "100", "-3"):
        with pytest.raises(ConfigError, match=f"--realtime-priority: found {number}, expected 1"):
            realtime_options(parsed("--realtime-priority", number), None)
    with pytest.raises(SystemExit):
        parsed("--cpu-affinity", "all")
    assert "found 'all', expected CPUs such as 2,4-6" in capsys.readouterr().err
