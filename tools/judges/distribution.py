"""Another distribution of ROS 2: the tests of the gateway with ROS, in an environment that has its wheels.

``python tools/judges/distribution.py --python PATH --name NAME``: the Python of an environment with rclpy, with what
igtl-gateway needs, and with pytest, pytest-xdist and hypothesis.  Writes docs/evidence/real-programs/NAME.jsonl; exit
code 1 if a test fails.

Strategy: the tests are those of the gate, of this work tree, in a process for each row.  Nodes that begin at one moment
in one process do not always find each other with Fast DDS (1 to 3 of 40 pairs here, of plain rclpy), so a row has a
second run, as in the gate.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.places import ROOT
from tools.judges import results
from tools.judges.results import BOTH, EXACT, FAILS, Row

#: What is tried, and the files of its tests.
TRIED = {
    "messages with uint8[]: late joiners, and bursts that are read late": ("integration/test_late_joiners.py",),
    "the node: topics, qualities of service, losses, commands, parameters": (
        "edges/ros/test_edge.py",
        "edges/ros/test_publishing.py",
        "edges/ros/test_receiver.py",
        "edges/ros/test_parameters.py",
        "edges/ros/test_env.py",
    ),
    "every row of the tables of conversions, a service, queries": ("integration/test_ros_types.py",),
    "a managed node, its parameters and arguments": (
        "integration/test_lifecycle.py",
        "integration/test_bridge_parameters.py",
        "integration/test_ros_arguments.py",
    ),
    "recordings replayed to nodes, and marks of them": (
        "integration/test_replay_ros.py",
        "integration/test_marks_of_ros.py",
    ),
    "arms of CRTK": ("integration/test_crtk.py",),
}
NEEDED = ("rclpy", "numpy", "mcap", "fastcrc", "rosbags", "pytest", "xdist", "hypothesis")
VERSIONS = (
    "import importlib.util, sys; from importlib.metadata import version\n"
    f"missing = [name for name in {NEEDED} if importlib.util.find_spec(name) is None]\n"
    "sys.exit('found no ' + ', '.join(missing)) if missing else None\n"
    "print(f\"rclpy {version('rclpy')}, rmw_fastrtps_cpp {version('ros-rmw-fastrtps-cpp')}\")"
)


def tried(python: str, what: str, files: tuple[str, ...]) -> Row:
    """Run the tests of a row; if one fails a second time, which the text states, as the gate does."""
    first = _run(python, what, files)
    if first.result == EXACT:
        return first
    second = _run(python, what, files)
    return replace(second, text=second.text or f"in the second run; in the first one {first.text}")


def _run(python: str, what: str, files: tuple[str, ...]) -> Row:
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        paths = [str(ROOT / "tests" / name) for name in files]
        command = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junit-xml={report}", *paths]
        code = subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode
        if not report.is_file():  # a test that hangs ends all of them
            return Row(what, BOTH, FAILS, 1, f"a test hung, and ended the others (exit code {code})")
        cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    ended = {
        state: [case for case in cases if case.find(state) is not None] for state in ("failure", "error", "skipped")
    }
    bad = [str(case.get("name")) for case in (*ended["failure"], *ended["error"])]
    passed = len(cases) - len(bad) - len(ended["skipped"])
    assert passed or bad, f"{what}: no test ran"
    return Row(what, BOTH, FAILS if bad else EXACT, passed, f"failed: {', '.join(bad)}" if bad else "")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", required=True, metavar="PATH", help="of the environment")
    parser.add_argument("--name", required=True, help="of the file with the results, and of the distribution")
    options = parser.parse_args()
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("LD_LIBRARY", "_ROS_WHEELS"))}
    os.environ.clear()  # the wheels of this environment are not those of the other one
    os.environ.update(clean)
    asked = subprocess.run([options.python, "-c", VERSIONS], capture_output=True, text=True, check=False)
    if asked.returncode:
        parser.error(f"--python: {asked.stderr.strip()[-200:]}")
    rows = [tried(options.python, what, files) for what, files in TRIED.items()]
    program = f"ROS 2 {options.name.title()}: rclpy and Fast DDS"
    return results.write(options.name, program, asked.stdout.strip(), "the node of the gateway, and others", rows)


if __name__ == "__main__":
    sys.exit(main())
