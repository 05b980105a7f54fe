"""``--help`` of every verb: it fits a terminal, its examples are valid, its defaults look the same; ``--version``."""

from __future__ import annotations

import argparse
import re
import shlex
import string
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from igtl_gateway.base.version import __version__
from igtl_gateway.cli import complete, main, versions
from igtl_gateway.cli.options import HelpFormatter
from igtl_gateway.cli.ros_arguments import without_ros_arguments
from igtl_gateway.cli.terminal import Parser
from igtl_gateway.cli.verbs import available
from igtl_gateway.record.sessionfile.layout import PRESENT_VERSIONS
from igtl_gateway.wire.header import HEADER_VERSIONS
from tests.places import FIXTURES
from tests.tables import table

COLUMNS = 80
STAR = FIXTURES / "star.mcap"


@pytest.fixture(params=available())
def parser(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> argparse.ArgumentParser:
    """The complete parser of a verb, on a terminal with 80 columns."""
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    verb = available()[request.param]
    made = Parser(f"igtl-gateway {verb.now or request.param}", formatter_class=HelpFormatter)
    complete(made, verb)
    return made


def commands(epilog: str) -> Iterator[list[str]]:
    """The words of each example, without what stands before and behind a pipe or a redirection."""
    for line in epilog.replace("\\\n", " ").splitlines():
        if match := re.search(r"^ +(?:.*\| )?(igtl-gateway [^|>]*)", line):
            yield shlex.split(match[1])


def test_help_fits_a_terminal(parser: argparse.ArgumentParser) -> None:
    assert [line for line in parser.format_help().splitlines() if len(line) > COLUMNS] == []


@pytest.mark.parametrize("name", available())
def test_prose_and_comments_fit_a_narrow_terminal(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands keep their lines, to be copied."""
    monkeypatch.setenv("COLUMNS", "40")
    made = argparse.ArgumentParser("igtl-gateway", formatter_class=HelpFormatter)
    complete(made, available()[name])
    _, *lines = made.format_help().splitlines()
    assert [line for line in lines if len(line) > 40 and line.startswith(("  #", *string.ascii_letters, "`"))] == []


def test_examples_are_valid(parser: argparse.ArgumentParser) -> None:
    examples = list(commands(str(parser.epilog)))
    assert examples
    for words in examples:
        name = parser.prog.split()
        assert words[: len(name)] == name
        parser.parse_args(without_ros_arguments(words[len(name) :])[0])


def test_every_option_has_help_and_one_form_of_default(parser: argparse.ArgumentParser) -> None:
    for action in parser._actions:
        if action.help == argparse.SUPPRESS:
            continue
        assert action.help and not action.help.endswith(".")
        assert "%(default)s" not in action.help
        assert not re.search(r"\(default [^:]|may be repeated", action.help)
        if isinstance(action, argparse._AppendAction):
            assert "(repeatable)" in action.help


def test_a_verb_with_many_options_has_a_short_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["replay", "--help"])
    assert capsys.readouterr().out.startswith("usage: igtl-gateway replay [OPTION ...] --to {igtl,ros,both} FILE\n")


@pytest.mark.parametrize(
    ("verb", "common", "rare"), [("bridge", "--record FILE", "--cpu-affinity"), ("replay", "--rate FACTOR", "--exact")]
)
def test_the_short_help_has_what_most_sessions_need(
    verb: str, common: str, rare: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = []
    for option in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as end:
            main([verb, option])
        assert end.value.code == 0
        pages.append(capsys.readouterr().out.partition("examples:")[0])
    short, full = pages
    assert common in short and common in full and rare in full and rare not in short
    counts = [len(re.findall(r"^  -", page, re.MULTILINE)) for page in pages]
    assert 18 <= counts[0] <= 28 < counts[1]
    assert "fault injection" not in short and "fault injection" in full


def test_version_names_formats_and_libraries(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    first, *rows = capsys.readouterr().out.splitlines()
    assert first == f"igtl-gateway {__version__}"
    names = {re.split(r"  +", row.strip())[0] for row in rows}
    assert {"session log", "OpenIGTLink", "Python", "C part", "numpy", "mcap", "rclpy", "laboratory"} <= names
    assert " and ".join(map(str, PRESENT_VERSIONS)) == versions.FORMAT_VERSIONS
    assert versions.HEADER_VERSIONS == " and ".join(map(str, HEADER_VERSIONS))


@table(
    ("words", "old"),
    [
        (["slice", str(STAR), "OUT.mcap", "--end", "1"], "OUT.mcap: the new spelling is -o OUT.mcap"),
        (["export", str(STAR), "--to", "csv", "--out", "OUT"], "--out: the new spelling is -o/--output"),
        (["import", "absent.bag", "--out", "OUT.mcap"], "--out: the new spelling is -o/--output"),
        (["decode", "absent.igtl", "--reencode", "OUT.igtl"], "--reencode: the new spelling is -o/--output"),
        (["view", "absent.mcap", "--save", "OUT.rrd"], "--save: the new spelling is -o/--output"),
        (["view", "absent.mcap", "--screenshot=OUT.png"], "--screenshot: the new spelling is -o/--output"),
        (["review", "absent.mcap", "--csv", "OUT.csv"], "--csv: the new spelling is -o/--output"),
        (["cohort", "info", "absent", "--out", "OUT"], "--out: the new spelling is -o/--output"),
        (["keep", "absent", "--to", "s3://bucket"], "--to: the new spelling is --upload"),
        (["keep", "absent", "--upload", "s3://bucket", "--rate", "2"], "--rate: the new spelling is --upload-rate"),
        (["simulate", "star", "--out", "OUT.mcap", "--seed", "x"], "--out: the new spelling is -o/--output"),
    ],
)
def test_old_spellings_of_outputs_name_the_new_one(
    words: list[str], old: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with suppress(SystemExit):
        main([word.replace("OUT", str(tmp_path / "out")) for word in words])
    err = capsys.readouterr().err
    line = f"igtl-gateway {words[0]}: {old}".replace("OUT", str(tmp_path / "out"))
    assert err.splitlines()[0] == line
    assert "--out:" not in line or "--out " not in parsed_help(words[0], capsys)


def parsed_help(verb: str, capsys: pytest.CaptureFixture[str]) -> str:
    with suppress(SystemExit):
        main([verb, "--help"])
    return capsys.readouterr().out


def test_a_slice_needs_one_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["slice", str(STAR)]) == 2
    assert main(["slice", str(STAR), "a.mcap", "-o", "b.mcap"]) == 2
    assert "expected -o OUT" in capsys.readouterr().err


@table(
    "words, error",
    [
        ("diff STAR STAR --streams TRANSFORM/* --streams Toool", "streams Toool: matches no recorded stream"),
        (
            "diff STAR STAR --streams Foo",
            "streams: found 'Foo', expected a recorded stream: igtl-gateway info",
        ),
        ("slice STAR -o OUT.mcap --streams Foo", "--streams: found 'Foo', expected a recorded stream"),
        (
            "replay STAR --to igtl --through-gateway --streams Foo",
            "--streams: found 'Foo', expected one of these streams",
        ),
        ("replay STAR --to igtl --send /star/tool", "--send: found recorded outputs, expected --through-gateway"),
        ("doctor 127.0.0.1:1 --allow any", "--allow: found no --listen, expected it"),
        ("decode STAR --overwrite", "--overwrite: found no -o OUT, expected it"),
        ("sync STAR --overwrite", "--overwrite: found neither -o nor --plot, expected one"),
        ("view STAR -o OUT.rrd --at 3", "--at: found no -o OUT.png, expected it"),
        ("cohort info STAR -o OUT --plan /plan", "--plan: found info, expected review"),
        ("cohort review STAR -o OUT --max-lag 3", "--max-lag: found review, expected sync"),
        ("merge STAR STAR -o OUT.mcap --max-lag 3", "--max-lag: found no --sync STREAM STREAM"),
        ("replay STAR --to ros --tls", "--tls: found --to ros, expected --to igtl or --to both"),
        ("replay STAR --to igtl --connect a:1 --allow any", "--allow: found --connect without --listen"),
        ("replay STAR --to igtl --connect a:1 --wait-peers 2", "--wait-peers: found 2, expected at most 1: --connect"),
        ("bridge --no-ros --ros dds", "--ros dds: found --no-ros or --relay, expected neither"),
        (
            "bridge --no-ros --connect plus:18944 --peer plus:18945=plus",
            "--peer: found plus:18945, expected an address of --listen or --connect: plus:18944",
        ),
        ("bridge --no-ros --peer 127.0.0.1=plus", "expected an address of --listen or --connect: 127.0.0.1:18944"),
        ("bridge --no-ros --listen 127.0.0.1:0 --page --page-address 0.0.0.0:0", "expected --allow NETWORK"),
        ("export STAR --to csv -o OUT.mcap", "-o: found '"),
        (
            "export STAR --to igs.mha -o OUT.nrrd",
            "the name of an image or a volume, expected an image or a volume: *.mha",
        ),
    ],
)
def test_what_has_no_effect_or_selects_nothing_is_refused(
    words: str, error: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [word.replace("STAR", str(STAR)).replace("OUT", str(tmp_path / "out")) for word in words.split()]
    assert main(found) == 2
    told = capsys.readouterr().err
    assert error in told and told.count("\n") == 1
    assert not list(tmp_path.iterdir())


@table(
    ("words", "dest", "found"),
    [
        ("cohort info -o OUT a b", "sources", "a b"),
        ("merge a.mcap -o OUT.mcap --json b.mcap", "files", "a.mcap b.mcap"),
        ("sync a.mcap /tool --json /camera", "streams", "/tool /camera"),
        ("view a.mcap --web b.mcap", "other", "b.mcap"),
    ],
)
def test_options_may_stand_between_files(words: str, dest: str, found: str) -> None:
    name, *rest = words.split()
    made = Parser(name)
    complete(made, available()[name])
    options, unknown = made.parse_known_args(rest)
    value = getattr(options, dest)
    assert " ".join(map(str, value if isinstance(value, list) else [value])) == found and not unknown
    assert made.parse_known_args([*rest, "--absent"])[1] == ["--absent"]
