"""``igtl-gateway resim``: a recording drives ROS 2 programs again, and their outputs are compared."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.addon.terminal import (
    RECORDING_OR_BAG,
    Parser,
    add_json,
    add_overwrite,
    default,
    new_recording,
    output_file,
)

EXAMPLES = """\
  # three runs, compared with each other and with what the recording has
  igtl-gateway resim session.mcap -- python planner.py
  # keep the outputs, and compare later versions with them
  igtl-gateway resim session.mcap --record good.mcap -- python planner.py
  igtl-gateway resim session.mcap --baseline good.mcap \\
      --tolerance 0.05mm,0.05deg \\
      -- python planner.py
  # two programs: what one publishes, the other one receives
  igtl-gateway resim session.mcap -- python planner.py -- python controller.py
  # a client of OpenIGTLink gets what the gateway sent to it, in lock-step
  igtl-gateway resim session.mcap --igtl-client -- python client.py
  # a part of the recording; all recordings of a folder, in a table
  igtl-gateway resim session.mcap --start 12 --end 20 -- python planner.py
  igtl-gateway resim sessions/*.mcap -- python planner.py
  # which commit changed the outputs?
  igtl-gateway resim session.mcap --bisect v1.0..HEAD --build "colcon build" \\
      -- python planner.py

Exit code 0: all runs are equal, and equal to the recording or the baseline;
1: they differ, and the first difference is named; 2: cannot be judged, because
of a program (it ended, hung, published nothing), a file, or this machine.
Of several recordings: 0: all are as above with 0; 1: one is not."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files", metavar="FILE", nargs="+", type=Path,
        help=f"{RECORDING_OR_BAG}; of several, a table. Behind --: the program and its arguments, -- between two",
    )  # fmt: skip
    parser.usage = "%(prog)s [OPTION ...] FILE ... -- PROGRAM"
    if isinstance(parser, Parser):
        parser.takes_programs = True
    parser.add_argument(
        "--recipe", type=Path, metavar="FILE",
        help="the programs, with names, environment and folders (TOML), instead of those behind --",
    )  # fmt: skip
    parser.add_argument("--start", metavar="TIME", help="start at this time " + default("the beginning"))
    parser.add_argument("--end", metavar="TIME", help="skip messages from this time on " + default("the end"))
    igtl = parser.add_mutually_exclusive_group()
    igtl.add_argument(
        "--igtl-client", action="store_true",
        help="the program is an OpenIGTLink client of the gateway; it finds the address in $IGTL_HOST and $IGTL_PORT, "
        "or {port} in its arguments",
    )  # fmt: skip
    igtl.add_argument(
        "--igtl-server", type=int, metavar="PORT",
        help="the program is an OpenIGTLink server at this port; 0: a free one, as for a client",
    )  # fmt: skip
    parser.add_argument(
        "--link", type=int, default=0, metavar="N",
        help="link of the recording whose peer the OpenIGTLink program replaces " + default("the only one"),
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=3, metavar="N", help="how often to run " + default(3))
    parser.add_argument("--record", type=new_recording, metavar="FILE", help="write the outputs of the first run")
    parser.add_argument(
        "--baseline", type=Path, metavar="FILE", help="compare with the outputs of an earlier run, not the recording"
    )
    parser.add_argument(
        "--tolerance", default="", metavar="MM,DEG", help="what may differ from them, such as 0.05mm,0.05deg"
    )
    parser.add_argument(
        "--input", action="append", default=[], metavar="TOPIC",
        help="drive a topic with the recording although a program publishes it (repeatable)",
    )  # fmt: skip
    parser.add_argument(
        "--output", action="append", default=[], metavar="TOPIC",
        help="do not drive a topic with the recording; judge it also if every node has it (repeatable)",
    )  # fmt: skip
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="TOPIC",
        help="run programs that ask for a topic which nothing has (repeatable)",
    )
    parser.add_argument(
        "--swap-ties",
        action="store_true",
        help="in every second run, timers come before messages of the same time: finds timers that race a topic",
    )
    parser.add_argument(
        "--permit-races",
        action="store_true",
        help="a timer may race a topic: for programs that sample by a timer deliberately",
    )
    parser.add_argument(
        "--any-start", action="store_true", help="outputs must not depend on when the programs start, as samples do"
    )
    parser.add_argument(
        "--latency", type=float, default=0.0, metavar="MS",
        help="of messages from program to program, in session time " + default(0),
    )  # fmt: skip
    parser.add_argument(
        "--lead", type=float, default=0.0, metavar="S",
        help="session time in which the programs start, before the recording begins " + default(0),
    )  # fmt: skip
    clocks = parser.add_mutually_exclusive_group()
    clocks.add_argument(
        "--libc-clock", action="store_true", help="time.time() is session time, not that of another day in each run"
    )
    clocks.add_argument("--real-clock", action="store_true", help="clocks and sleeps outside of ROS are real")
    parser.add_argument(
        "--wall-limit", type=float, default=30.0, metavar="S",
        help="real time in which a program has to come to rest " + default(30),
    )  # fmt: skip
    parser.add_argument(
        "--cpu-limit", type=float, default=60.0, metavar="S",
        help="CPU time in which a program has to come to rest " + default(60),
    )  # fmt: skip
    parser.add_argument(
        "--bisect", metavar="GOOD..BAD",
        help="find the commit of the git repository here that changed the outputs, in a temporary clone",
    )  # fmt: skip
    parser.add_argument(
        "--build", default="", metavar="CMD", help="with --bisect: the shell command that builds a commit"
    )
    parser.add_argument(
        "--junit", type=output_file(".xml"), metavar="FILE", help="write the verdict in the format of JUnit"
    )
    add_overwrite(parser, "the outputs and the report")
    add_json(parser)


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.addons.resim.verb_run import run  # here: the help does not wait for it

    return run
