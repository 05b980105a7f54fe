"""Arguments of ROS 2 in a command line: from ``--ros-args`` to ``--`` or to the end, as in every ROS node."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from igtl_gateway.cli.options import Options

BEGIN, END = "--ros-args", "--"


def add_ros_arguments(group: Options, what: str) -> None:
    """Add ``--ros-args`` for the help; `without_ros_arguments` has taken it before the options are read.

    Args:
        group: the parser, or a group of it.
        what: what the arguments of ROS may be.
    """
    group.add_argument(
        BEGIN,
        action=_Shortened,
        nargs=argparse.REMAINDER,
        default=[],
        metavar="…",
        help=f"arguments of ROS 2, to the end or to --: {what}",
    )


class _Shortened(argparse.Action):
    """What is left of `without_ros_arguments`: a beginning of ``--ros-args``, which would take all words behind it."""

    def __call__(self, parser: argparse.ArgumentParser, *given: object) -> None:
        parser.error(f"found the beginning of {BEGIN}, expected all of it, or another option")


def without_ros_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words of a command line in two parts.

    Args:
        words: the command line.

    Returns:
        The words that are ours, and those of ROS: each part from ``--ros-args`` to before ``--``.
    """
    own: list[str] = []
    ros: list[str] = []
    part = own
    for word in words:
        if word == BEGIN and part is own:
            part = ros
        if word == END and part is ros:
            part = own
        else:
            part.append(word)
    return own, ros
