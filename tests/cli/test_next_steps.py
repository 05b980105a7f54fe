"""What a verb proposes next: commands that run as printed."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import pytest
from mcap.writer import Writer

from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.cli import main
from igtl_gateway.cli.next_steps import command, info_steps, print_next
from tests.places import FIXTURES
from tests.plus_sequences import tracked
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
            {"types": ["STRING/A"]},
            ["verify", "replay", "export", "view"],
        ),
        ({"verifies": False, "types": ["STRING/A"]}, ["replay", "export", "view"]),
        ({"has_problems": True}, ["verify", "doctor", "view"]),
        ({"is_foreign": True}, ["import", "view"]),
        ({"is_foreign": True, "is_bag": True}, ["import"]),
        ({"is_foreign": True, "is_empty": True}, []),
        ({"is_empty": True}, ["verify", "view"]),
    ],
)
def test_what_follows_info(facts: dict[str, object], verbs: list[str]) -> None:
    all_facts: dict[str, object] = dict.fromkeys(("is_foreign", "is_bag", "is_empty", "has_problems"), False)
    all_facts |= {"verifies": True, "types": [], **facts}
    assert [shlex.split(step)[1] for step, _ in info_steps("x.mcap", **all_facts)] == verbs  # type: ignore[arg-type]


def test_what_verify_refuses_is_not_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    imported = tmp_path / "imported.mcap"
    tracked(tmp_path / "sweep.igs.mha")
    assert main(["import", str(tmp_path / "sweep.igs.mha"), "-o", str(imported)]) == 0
    capsys.readouterr()
    assert main(["info", str(imported)]) == 0
    steps = capsys.readouterr().out.partition("\nnext\n")[2]
    assert " verify " not in steps and " replay " in steps
    assert main(["verify", str(imported)]) == 2, "it refuses an import"


def test_nothing_is_proposed_for_a_file_of_which_nothing_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "json.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/a", "json", writer.register_schema("lab.A", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "found encoding 'json', expected 'cdr'" in text and "next" not in text


def test_a_merged_session_is_verified_if_no_part_is_an_import(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported = tmp_path / "imported.mcap"
    tracked(tmp_path / "sweep.igs.mha")
    assert main(["import", str(tmp_path / "sweep.igs.mha"), "-o", str(imported)]) == 0
    for name, other, code in (("both", FIXTURES / "crtk.mcap", 0), ("mixed", imported, 2)):
        merged = tmp_path / f"{name}.mcap"
        words = ["merge", str(FIXTURES / "brain.mcap"), str(other), "-o", str(merged), "--offset", f"{other.stem}=0"]
        assert main(words) == 0
        capsys.readouterr()
        assert main(["info", str(merged)]) == 0
        steps = capsys.readouterr().out.partition("\nnext\n")[2]
        assert (" verify " in steps, " import " in steps, " view " in steps) == (code == 0, False, True)
        assert main(["verify", str(merged)]) == code


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
    assert f"read_parquet('{tables}/*.parquet', filename=true)" in found.stdout.decode()


def test_json_has_no_such_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(FIXTURES / "paper-types.mcap"), "--json"]) == 0
    assert capsys.readouterr().out.count("\n") == 1
