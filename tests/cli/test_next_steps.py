"""What a verb proposes next: commands that run as printed."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.cli import main
from igtl_gateway.cli.next_steps import command, info_steps, print_next
from tests.places import FIXTURES
from tests.tables import table


def test_a_command_is_quoted_for_a_shell() -> None:
    assert shlex.split(command("view", "my session.mcap")) == ["igtl-gateway", "view", "my session.mcap"]


def test_steps_stand_in_two_columns(capsys: pytest.CaptureFixture[str]) -> None:
    print_next(("a", "first"), ("longer", "second\x1b[2J"))
    assert capsys.readouterr().out == "next\n  a       first\n  longer  second\\x1b[2J\n"


@pytest.mark.parametrize(
    ("facts", "verbs"),
    [
        (
            {"is_foreign": False, "is_bag": False, "has_problems": False, "types": ["STRING/A"]},
            ["verify", "replay", "export", "view"],
        ),
        ({"is_foreign": False, "is_bag": False, "has_problems": True, "types": []}, ["verify", "doctor", "view"]),
        ({"is_foreign": True, "is_bag": False, "has_problems": False, "types": []}, ["import", "view"]),
        ({"is_foreign": True, "is_bag": True, "has_problems": False, "types": []}, ["import"]),
    ],
)
def test_what_follows_info(facts: dict[str, object], verbs: list[str]) -> None:
    assert [shlex.split(step)[1] for step, _ in info_steps("x.mcap", **facts)] == verbs  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_proposed_commands_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(FIXTURES / "paper-types.mcap")]) == 0
    lines = capsys.readouterr().out.partition("\nnext\n")[2].splitlines()
    verify = next(line.split("  ")[1] for line in lines if " verify " in line)
    assert main(shlex.split(verify)[1:]) == 0
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert main(["review", str(FIXTURES / "star.mcap")]) == 1
    lines = capsys.readouterr().out.partition("\nnext\n")[2].splitlines()
    assert main(shlex.split(lines[1].split("  ")[1])[1:]) == 1
    assert (tmp_path / "stitches.csv").is_file()


def test_each_format_says_what_to_do_with_the_result() -> None:
    assert all("{out}" in target.next_step or "{count}" in target.next_step for target in TARGETS.values())


@table("name", ["tables", "two words", "it's", 'a"b', "$HOME"])
def test_the_query_of_tables_is_one_for_any_name(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / name
    words = ["export", str(FIXTURES / "paper-types.mcap"), "--to", "parquet", "-o", str(out), "--streams", "STRING/*"]
    assert main(words) == 0
    step = capsys.readouterr().out.splitlines()[-1].removeprefix("next: ")
    found = subprocess.run(["sh", "-c", step.replace("duckdb -c", "printf %s")], capture_output=True, check=True)
    tables = str(out).replace("'", "''")
    assert found.stdout.decode() == f"SELECT count(*) FROM '{tables}/*.parquet'"


def test_json_has_no_such_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(FIXTURES / "paper-types.mcap"), "--json"]) == 0
    assert capsys.readouterr().out.count("\n") == 1
