"""``igtl-gateway export``: a session in the formats of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.cli.common import count
from igtl_gateway.cli.terminal import cell, print_json, say, width
from igtl_gateway.errors import GatewayError
from igtl_gateway.exchange.targets import TARGETS
from igtl_gateway.replay.mcap_reader import SessionFile

EXAMPLES = """\
  igtl-gateway export out.mcap --to rosbag2 -o bag/             the ROS topics, for `ros2 bag play bag/`
  igtl-gateway export out.mcap --to igs.mha -o freehand.igs.mha an IMAGE and its TRANSFORMs, for PLUS and 3D Slicer
  igtl-gateway export out.mcap --to csv -o tables/ --streams 'TRANSFORM/*'
  igtl-gateway export out.mcap --to ply -o clouds/ --streams /star/cloud
  igtl-gateway export out.mcap --to nrrd -o volumes/

exit code 1 if messages of the chosen streams could not be written; the table shows why."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", type=Path, help="a recording")
    parser.add_argument(
        "--to",
        choices=tuple(TARGETS),
        required=True,
        help="; ".join(f"{name}: {target.text}" for name, target in TARGETS.items()),
    )
    parser.add_argument("-o", "--out", metavar="OUT", type=Path, required=True, help="the file or folder to write")
    parser.add_argument(
        "--streams",
        action="append",
        default=[],
        metavar="GLOB",
        help="only these: TYPE/device, device or topic (* one level, ** any); may be repeated",
    )
    parser.add_argument("--json", action="store_true", help="print the outcome as one JSON object")


def run(options: argparse.Namespace) -> int:
    with SessionFile.open(options.file) as file:
        try:
            account = TARGETS[options.to].export(file, options.out, options.streams)
        except OSError as error:
            raise GatewayError(f"cannot write to {options.out}: {error.strerror or error}") from None
    written = sum(row.taken for row in account.rows)
    if not written:
        raise GatewayError(
            f"{options.file}: nothing in it goes to {options.to}: see `igtl-gateway info`, and --streams"
        )
    good = all(row.good for row in account.rows)
    if options.json:
        rows = [
            {
                "stream": row.stream,
                "type": row.type,
                "found": row.declared,
                "exported": row.taken,
                "left_out": row.left_out,
                "why": row.why,
            }
            for row in account.rows
        ]
        told = {"file": str(options.file), "to": options.to, "out": str(options.out), "good": good}
        print_json({**told, "files": account.files, "rows": rows, "notes": account.notes})
        return 0 if good else 1
    streams = width(row.stream for row in account.rows)
    kinds = width(row.type for row in account.rows)
    for row in account.rows:
        mark = " " if row.good else "!"
        numbers = f"{row.declared:>10,} {row.taken:>10,} {row.left_out:>10,}"
        say(f"{mark} {cell(row.stream, streams)}  {cell(row.type, kinds)} {numbers}  {row.why}".rstrip())
    for note in account.notes:
        say(f"note: {note}")
    say(f"{options.out}: {count(written, 'message')} in {count(account.files, 'file')}")
    return 0 if good else 1
