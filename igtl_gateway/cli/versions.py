"""``--version``: the versions that matter for a bug report, found without importing what they belong to."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from igtl_gateway.base.version import __version__
from igtl_gateway.cli.terminal import print_line

#: What the program calls a library → names of distributions that contain it.
_LIBRARIES = {
    "numpy": ("numpy",),
    "mcap": ("mcap",),
    "fastcrc": ("fastcrc",),
    "rclpy": ("rclpy", "ros-jazzy-rclpy"),
    "rerun": ("rerun-sdk",),
    "PyAV": ("av",),
    "nibabel": ("nibabel",),
    "laboratory": ("igtl-gateway-lab",),
}
#: Equal to ``sessionfile.layout.PRESENT_VERSIONS`` and ``wire.header.HEADER_VERSIONS``, as a test ensures: importing
#: these modules takes longer than everything else here.
FORMAT_VERSIONS, HEADER_VERSIONS = "1 and 2", "1 and 2"
_C_PART = "igtl_gateway.native._express"


class VersionAction(argparse.Action):
    """Print the versions and end the program."""

    def __init__(self, option_strings: list[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        import platform  # here: no other option needs it

        rows = {
            "session log": f"file format versions {FORMAT_VERSIONS}",
            "OpenIGTLink": f"header versions {HEADER_VERSIONS}",
            "C part": "present" if find_spec(_C_PART) else "not present, Python is used instead",
            "Python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
            **dict(_libraries()),
        }
        print_line(f"igtl-gateway {__version__}", *(f"  {name:<13}{text}" for name, text in rows.items()))
        parser.exit()


def _libraries() -> Iterator[tuple[str, str]]:
    for library, distributions in _LIBRARIES.items():
        text = next(filter(None, map(_version, distributions)), "not installed")
        if library == "rclpy" and (text != "not installed" or find_spec("rclpy")):
            text = text.replace("not installed", "of an unknown version")
            text += f", RMW {os.environ.get('RMW_IMPLEMENTATION') or 'by default'}"
        yield library, text


def _version(distribution: str) -> str:
    from importlib import metadata  # here: no verb waits for it

    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""
