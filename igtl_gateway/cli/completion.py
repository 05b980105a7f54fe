"""``igtl-gateway completion``: the script by which a shell completes verbs, options, values and file names.

The script is generated from the parsers of all installed verbs, those of the laboratory too.  The shell runs no Python
to complete a word, so the script has to be written again after an update.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import shtab

from igtl_gateway import cli
from igtl_gateway.cli.terminal import print_text

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
    return f"{shtab.complete(parser, shell)}\n"
