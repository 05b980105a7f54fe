"""``igtl-gateway completion``: the script by which a shell completes verbs, options, values and file names.

The script is generated from the parsers of all installed verbs, those of the laboratory too.  The shell runs no Python
to complete a word, so the script has to be written again after an update.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import shtab

from igtl_gateway import cli
from igtl_gateway.cli.terminal import print_text
from igtl_gateway.cli.verbs import JOINED

SHELLS = ("bash", "zsh", "fish")

EXAMPLES = """\
  # bash: in new shells, if the package bash-completion is installed
  cd ~/.local/share/bash-completion/completions
  igtl-gateway completion bash > igtl-gateway
  # bash: in this shell
  eval "$(igtl-gateway completion bash)"
  # zsh: in a folder of $fpath, before compinit runs
  igtl-gateway completion zsh > ~/.zfunc/_igtl-gateway
  # fish
  igtl-gateway completion fish > ~/.config/fish/completions/igtl-gateway.fish"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help=f"the shell: {', '.join(SHELLS)}")


def run(options: argparse.Namespace) -> int:
    print_text(script(options.shell))
    return 0


def script(shell: str) -> str:
    """Return the script for one of :data:`SHELLS`."""
    parser, parsers = cli.parser_of_all_verbs()
    for action in (action for each in parsers for action in each._actions):
        if action.type is Path or action.metavar == "FILE":
            action.complete = shtab.DIRECTORY if action.metavar == "DIR" else shtab.FILE  # type: ignore[attr-defined]
    for (name, word), (_, following) in JOINED.items():
        joined = next(each for each in parsers if each.prog.endswith(f" {name}"))
        joined.add_argument("following", nargs="?").complete = _after(word, following)  # type: ignore[attr-defined]
    return f"{shtab.complete(parser, shell)}\n"


def _after(word: str, following: Sequence[str]) -> dict[str, Any]:
    """Return what completes the second argument of a verb in each shell: these words, if the first one is ``word``."""
    names = " ".join(each for each in following if not each.startswith("-"))
    function = f"_igtl_gateway_after_{word}"
    bash = f'{function}() {{\n  [ "${{COMP_WORDS[COMP_CWORD-1]}}" = {word} ] && compgen -W "{names}" -- $1\n}}\n'
    fish = f"(contains -- {word} (commandline -opc); and printf '%s\\n' {names})"
    return {"bash": function, "zsh": f"({names})", "fish": fish, "preamble": {"bash": bash}}
