"""The end of a verb's output for people: what the user can do next, with commands that run as printed."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from igtl_gateway.base.addons import is_present
from igtl_gateway.cli.terminal import cell, columns, print_line, width

PROGRAM = "igtl-gateway"
#: Columns between a command and what it does, and before it.
_BESIDE = 4


def command(*words: object) -> str:
    """Return a command line of this program, quoted for a shell."""
    return shlex.join([PROGRAM, *map(str, words)])


def print_next(*steps: tuple[str, str], title: str = "next") -> None:
    """Print commands and what they do, the commands in one column."""
    print_line(title)
    longest = max((len(step) + len(what) for step, what in steps), default=0) + _BESIDE
    for step, what in steps:
        if longest <= columns():
            print_line(f"  {cell(step, width(other for other, _ in steps))}  {what}")
        else:
            print_line(f"  {step}", f"      {what}")


def info_steps(
    file: str,
    *,
    is_foreign: bool,
    is_bag: bool,
    is_empty: bool,
    verifies: bool,
    has_problems: bool,
    types: Sequence[str],
) -> list[tuple[str, str]]:
    """Return what follows ``info`` of a complete recording.

    Args:
        file: the recording.
        is_foreign: whether another program wrote it; `merge` did not.
        is_bag: whether it is the folder of a bag, which only ``info`` and ``import`` read.
        is_empty: whether it has no message that is read.
        verifies: whether ``verify`` takes it: not an import, which has no outputs.
        has_problems: whether notes report problems.
        types: OpenIGTLink types in it.
    """
    if is_foreign:
        if is_empty:
            return []  # an import would be empty, too
        steps = [(command("import", file, "-o", "session.mcap"), "make a session of it")]
        return steps if is_bag else [*steps, (command("view", file), "show it in rerun")]
    steps = [(command("verify", file), "compute all outputs again and compare them")] if verifies else []
    if has_problems:
        steps.append((command("doctor", file), "find the causes of the problems"))
    if types:
        steps.append((command("replay", file, "--to", "igtl"), "serve it to 3D Slicer and others"))
        if is_present("exchange"):
            scene = f"{Path(file).name.removesuffix('.mcap')}.mrb"
            steps.append((command("export", file, "--to", "mrb", "-o", scene), "a scene that plays in 3D Slicer"))
    return [*steps, (command("view", file), "show it in rerun")]
