"""The scripts of ``completion``, in the shells themselves: what the words before the cursor become."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from igtl_gateway.cli.completion import SHELLS, script
from igtl_gateway.cli.verbs import VERBS
from tests.tables import table
from tests.timing import WAIT_S

#: Words up to the cursor → what the last one can become; files are those of ``folder``.
CASES = {
    "igtl-gateway reco": {"recover"},
    "igtl-gateway comp": {"completion"},
    "igtl-gateway bridge --realt": {"--realtime-priority"},
    "igtl-gateway bridge --profile br": {"brainlab"},
    "igtl-gateway replay --restamp ": {"keep", "now", "shift"},
    "igtl-gateway info morn": {"morning.mcap"},
    "igtl-gateway bridge --config ro": {"room.toml"},
    "igtl-gateway completion fi": {"fish"},
    "igtl-gateway seal keys ro": {"rotate"},
    "igtl-gateway seal morn": {"morning.mcap"},
    "igtl-gateway simulate ultra": {"ultrasound"},
}
#: The screen of a shell has one completed word.
ONE_RESULT = {line: found for line, found in CASES.items() if len(found) == 1}


def needs(shell: str) -> str:
    path = shutil.which(shell)
    if path is None:
        pytest.skip(f"no {shell} here")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion")
    for name in ("morning.mcap", "room.toml"):
        (path / name).touch()
    for shell in SHELLS:
        (path / f".{shell}").write_text(script(shell))
    return path


def environment(folder: Path) -> dict[str, str]:
    return {"PATH": os.environ["PATH"], "HOME": str(folder), "TERM": "dumb", "XDG_CONFIG_HOME": str(folder / ".config")}


def output(command: list[str], folder: Path) -> list[str]:
    done = subprocess.run(
        command, cwd=folder, env=environment(folder), capture_output=True, text=True, check=True, timeout=WAIT_S
    )
    return done.stdout.splitlines()


@table("line", CASES)
def test_bash(folder: Path, line: str) -> None:
    # Readline sets these variables; the function is the one that the script has registered.
    program = """
        source .bash
        words=${1% *} word=${1##* }
        COMP_WORDS=($words "$word") COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
        registered=($(complete -p igtl-gateway))
        while [ "${registered[0]}" != -F ]; do registered=("${registered[@]:1}"); done
        "${registered[1]}"
        printf '%s\\n' "${COMPREPLY[@]}"
    """
    found = output([needs("bash"), "--norc", "-c", program, "bash", line], folder)
    assert {word.strip() for word in found} == CASES[line]


@table("line", CASES)
def test_fish(folder: Path, line: str) -> None:
    program = "source .fish; complete -C $argv[1]"
    found = output([needs("fish"), "--no-config", "-c", program, line], folder)
    assert {row.partition("\t")[0] for row in found} == CASES[line]


def test_zsh(folder: Path) -> None:
    """A line and the key Tab, without Enter: zsh completes the line on its screen, and runs nothing."""
    needs("zsh")
    (folder / ".zfunc").mkdir()
    (folder / ".zfunc" / "_igtl-gateway").write_text(script("zsh"))
    (folder / ".zshrc").write_text("fpath+=(~/.zfunc); autoload -Uz compinit; compinit -D -u; PS1='> '; echo READY\n")
    process, screen = pty.fork()
    if process == 0:
        os.chdir(folder)
        os.execvpe("zsh", ["zsh", "-i"], environment(folder))
    try:
        read_until(screen, "READY")
        for line, (word,) in ONE_RESULT.items():
            os.write(screen, f" {line}\t".encode())
            read_until(screen, word.removeprefix(line.rpartition(" ")[2]))
            os.write(screen, b"\x15")  # erase the line
    finally:
        os.close(screen)
        os.kill(process, 9)
        os.waitpid(process, 0)


def read_until(screen: int, text: str) -> None:
    seen, end = "", time.monotonic() + WAIT_S
    while text not in seen.replace("\x08", ""):
        assert select.select([screen], [], [], max(0.0, end - time.monotonic()))[0], f"expected {text!r} in {seen!r}"
        seen += os.read(screen, 4096).decode(errors="replace")


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_names_every_verb_and_is_plain_text(
    shell: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert text == (folder / f".{shell}").read_text(), "nothing in it is escaped for a terminal"
    assert all(verb in text for verb in VERBS)


def test_another_shell_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["completion", "csh"])
    assert end.value.code == 2
    assert "invalid choice: 'csh'" in capsys.readouterr().err
