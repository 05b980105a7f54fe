"""The options of ``igtl-gateway export --to lerobot``."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.addon.terminal import default, output_file

LEROBOT = "lerobot"
LEROBOT_TEXT = "a training set by a recipe: streams at one rate, video, Parquet"
APPEND_TEXT = "add the sessions to the data set of -o, by its recipe unless there is --recipe"


def add_lerobot(parser: argparse.ArgumentParser) -> None:
    """Add the options that only this format has."""
    group = parser.add_argument_group("options of --to lerobot")
    group.add_argument("--recipe", metavar="FILE", type=Path, help="TOML file: rate, features, episodes")
    group.add_argument("--append", action="store_true", help=APPEND_TEXT)
    group.add_argument(
        "--write-recipe",
        metavar="FILE",
        type=output_file(".toml"),
        help="write a starting recipe, made of the recording's streams",
    )
    group.add_argument("--check", metavar="DIR", type=Path, help="check a data set, also against its recordings")
    group.add_argument(
        "--trace", metavar="DIR", type=Path, help="print the messages behind a frame, with recordings also their bytes"
    )
    group.add_argument(
        "--frame", metavar="[EPISODE:]FRAME", help="frame to trace: its number in the set or the episode"
    )
    group.add_argument("--feature", metavar="NAME", help="feature to trace " + default("all"))
