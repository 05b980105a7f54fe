"""Real packages of ROS 2 under re-simulation: tf2_ros, message_filters and rclcpp themselves, and tests of a package.

``python tools/judges/resim_packages.py --prefix DIR``: DIR has ``include/PACKAGE`` and ``lib`` of rclcpp, as an
installed ROS 2 has; Python packages are those that this Python imports.  ``--tests FILE...`` runs tests of a package,
whose outcomes are compared.  A package that is not installed is left out.  Exit code 1 if any run differs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.addons.resim.engine import Program
from tests.addons.resim import sessions
from tests.addons.resim.sessions import MS
from tools.evidence.resim_runs import HEADER, Row, pairs, texts, transforms
from tools.judges import cpp


def exact_pairs(path: Path) -> Path:
    """Each image at the time of a pose."""
    images = []
    for ns, topic, type_, image in sessions.images(20):
        image.header.stamp = sessions.stamp(ns - 3 * MS)
        images.append((ns, topic, type_, image))
    return sessions.write(path, [*sessions.poses(100), *images])


def python(name: str, *words: str) -> Callable[[Path], Sequence[Program]]:
    return lambda folder: [Program((sys.executable, str(cpp.PROGRAMS / f"{name}.py"), *words), name)]


def rclcpp(prefixes: Sequence[Path], *words: str) -> Callable[[Path], Sequence[Program]]:
    def programs(folder: Path) -> Sequence[Program]:
        return [Program((str(cpp.compiled("rclcpp_node.cpp", folder, prefixes)), *words), "node")]

    return programs


def rows(prefixes: Sequence[Path], tests: Sequence[str]) -> list[Row]:
    found = []
    if find_spec("tf2_ros"):
        found.append(Row("tf2_ros, one thread", transforms, python("tf2_node", "timer")))
        found.append(Row("tf2_ros, a thread of its own", transforms, python("tf2_node", "thread")))
    if find_spec("message_filters"):
        found.append(Row("message_filters, approximate", pairs, python("filters", "approximate")))
        found.append(Row("message_filters, exact", exact_pairs, python("filters", "exact")))
    if any((prefix / "include" / "rclcpp").is_dir() for prefix in prefixes):
        found.append(Row("rclcpp, one thread", texts(50), rclcpp(prefixes)))
        found.append(Row("rclcpp, several threads", texts(50), rclcpp(prefixes, "multi")))
        found.append(Row("rclcpp, EventsExecutor", texts(50), rclcpp(prefixes, "events")))
    if tests:
        found.append(Row("tests of a package", texts(50), python("package_tests", *tests)))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5, help="of each kind (default: 5)")
    parser.add_argument("--prefix", type=Path, action="append", default=[], help="folder of rclcpp (repeatable)")
    parser.add_argument("--tests", nargs="+", default=[], metavar="FILE", help="tests of a package")
    options = parser.parse_args()
    found = rows(options.prefix, options.tests)
    folder = Path(tempfile.mkdtemp(prefix="resim-packages-"))
    print(HEADER)
    for number, row in enumerate(found):
        row.turn(options.runs, folder / str(number))
        print(row.text(), *row.wrong, sep="\n", flush=True)
    return int(not found or any(row.wrong or len(row.hashes) != 1 for row in found))


if __name__ == "__main__":
    sys.exit(main())
