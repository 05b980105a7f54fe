"""Other implementations of OpenIGTLink as client and as server of the gateway, in a recorded and verified session.

``python tools/judges/foreign.py openigtlink4j --classes BUILT:slf4j-api.jar --version 4cbcb31``: what a person has
built, or ``--python INTERPRETER`` with the package installed, or ``--program PATH``.  Nothing is fetched, and built is
only our own program in ``programs/``, which calls the library.  Writes docs/evidence/real-programs/NAME.jsonl.

Strategy: as ``peers``, whose messages and rclpy node these are.  What differs from the protocol in a known way is a row
of ``Kind.faults``: its text stands in the result in place of "fails", with whose fault it is.
"""

from __future__ import annotations

import argparse
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.test_ros_types import CASES, NANOSEC, OUTGOING, SEC, Case, Sent, check, children, head, packed
from tests.peers import PeerError, only
from tools.judges import results
from tools.judges.foreign_peers import Implementation
from tools.judges.peers import FRAC, HEAD_BYTES, Place, world
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

PROGRAMS = Path(__file__).with_name("programs")
#: (type, device, direction) → what the program does otherwise; "*" for any type or device.
Faults = Mapping[tuple[str, str, str], str]


@dataclass(frozen=True)
class Kind:
    """An implementation.

    Attributes:
        program: its name.
        made: returns the command of our program with it.
        sends, reads: types that it has a class for.
        roles: whether it is a server, for each run.
        faults: what is known of it.
        stamp: nanoseconds of the fraction of its stamps in ROS; None: it sends none.
        options: of the bridge.
        instead: type → what the program gets in place of it.
        queries: whether GET_TRANS and STT_TDATA are tried.
    """

    program: str
    made: Callable[[argparse.Namespace, Path], list[str]]
    sends: Collection[str]
    reads: Collection[str]
    roles: tuple[bool, ...] = (False, True)
    faults: Faults = field(default_factory=dict)
    stamp: int | None = NANOSEC
    options: tuple[str, ...] = ()
    instead: Mapping[str, str] = field(default_factory=dict)
    queries: bool = False

    def fault(self, type_name: str, device: str, direction: str) -> str:
        keys = ((type_name, device, direction), (type_name, "*", direction))
        return next((self.faults[key] for key in keys if key in self.faults), "")


def java(source: str) -> Callable[[argparse.Namespace, Path], list[str]]:
    def made(options: argparse.Namespace, folder: Path) -> list[str]:
        if not options.classes:
            raise SystemExit("found no --classes, expected the class path of the library")
        subprocess.run(
            ["javac", "-nowarn", "-d", str(folder), "-cp", options.classes, str(PROGRAMS / f"{source}.java")],
            check=True,
        )
        return ["java", "-cp", f"{folder}:{options.classes}", source]

    return made


def python(source: str) -> Callable[[argparse.Namespace, Path], list[str]]:
    def made(options: argparse.Namespace, _: Path) -> list[str]:
        if not options.python:
            raise SystemExit("found no --python, expected the interpreter of an environment that has the package")
        return [options.python, str(PROGRAMS / f"{source}.py")]

    return made


def octave(options: argparse.Namespace, _: Path) -> list[str]:
    if not options.sources:
        raise SystemExit("found no --sources, expected the folder of the sender for MATLAB")
    return ["octave-cli", "--no-gui", str(PROGRAMS / "octave" / "peer_matlab.m"), str(Path(options.sources).resolve())]


def program(options: argparse.Namespace, _: Path) -> list[str]:
    if not options.program:
        raise SystemExit("found no --program, expected the path of the program")
    return [shutil.which(options.program) or options.program]


SEVEN = ("TRANSFORM", "POSITION", "STRING", "STATUS", "IMAGE", "NDARRAY", "CAPABILITY")
ASCII = "characters beyond US-ASCII are lost: its fault"
KINDS = {
    "openigtlink4j": Kind(
        "OpenIGTLink4J",
        java("Peer4j"),
        (*SEVEN, "SENSOR", "POINT", "TDATA"),
        ("TRANSFORM", "POSITION", "STRING", "STATUS", "IMAGE", "CAPABILITY", "SENSOR", "POINT", "TDATA"),
        stamp=NANOSEC // 10**6 * 10**6,
        options=("--profile", "openigtlink4j"),
        instead={"POSITION": "TRANSFORM"},
        queries=True,
        faults={
            ("POSITION", "*", TO_ROS): "it ends with an ArrayIndexOutOfBoundsException when it logs its own: its fault",
            ("STRING", "Text", TO_ROS): ASCII,
            ("STRING", "Words", TO_IGTL): ASCII,
            ("STATUS", "*", TO_IGTL): "strings keep the NUL at their end: its fault",
        },
    ),
    "openigtlink-java": Kind(
        "OpenIGTLink-Java (WPI)",
        java("PeerWpi"),
        SEVEN,
        ("TRANSFORM", "STRING", "IMAGE"),
        stamp=None,
        faults={
            ("STRING", "Text", TO_ROS): ASCII,
            ("IMAGE", "*", TO_ROS): "its writer has the directions by rows, its reader by columns: its fault",
            ("CAPABILITY", "*", TO_ROS): "names are not padded to 12 bytes: refused, with its name; its fault",
            ("STRING", "*", TO_IGTL): "a server loses characters beyond US-ASCII, a client ends at a STRING: its fault",
            ("IMAGE", "*", TO_IGTL): "it ends at an IMAGE of several components or slices: its fault",
        },
    ),
    "openigtlink-rust": Kind(
        "openigtlink-rust",
        program,
        (*SEVEN, "SENSOR", "POINT", "TDATA"),
        ("TRANSFORM", "POSITION", "STRING", "STATUS", "SENSOR", "POINT"),
        options=("--profile", "openigtlink-rust"),
        faults={
            ("IMAGE", "*", TO_ROS): "it lacks the fields of the sub-volume, and has the matrix by rows: refused, with "
            "its name; its fault",
            ("TDATA", "*", TO_ROS): "matrices by rows are left out: its fault",
            ("CAPABILITY", "*", TO_ROS): "a count, and names that end with NUL: refused, with its name; its fault",
        },
    ),
    "matlab": Kind(
        "MatlabOpenIGTLink, in Octave",
        octave,
        ("TRANSFORM", "STRING", "IMAGE"),
        (),
        (False,),
        stamp=None,
        faults={
            ("IMAGE", "*", TO_ROS): "its function has no arguments for this: colours, or a matrix with spacing",
        },
    ),
    "pyigtlink": Kind(
        "pyIGTLink",
        python("peer_pyigtlink"),
        ("TRANSFORM", "IMAGE"),
        (),
        (True,),
        faults={
            (
                "IMAGE",
                "*",
                TO_ROS,
            ): "columns and rows of the sub-volume are exchanged, RGB is declared as 2 components: "
            "refused, with its name; its fault",
        },
    ),
    "pygtlink": Kind(
        "pygtlink",
        python("peer_pygtlink"),
        ("POSITION", "STATUS", "IMAGE", "SENSOR"),
        ("POSITION", "STATUS", "IMAGE", "SENSOR"),
        faults={
            ("STATUS", "*", TO_ROS): "it sends no text: its fault",
            (
                "IMAGE",
                "*",
                TO_ROS,
            ): "the size is rows, columns, components in place of columns, rows, slices: its fault",
            ("IMAGE", "*", TO_IGTL): "it reshapes to columns, rows, slices, and fails with components: its fault",
            ("STATUS", "*", TO_IGTL): "it reads no text: its fault",
        },
    ),
}

#: How long a program has to report that it cannot send, and to report what it got.
_ERROR_S, _RECEIVE_S = 0.3, 3.0
#: The cases of ``peers`` that a program without metadata can send; of arrays only those in ``MORE``.
SENT = [case for case in CASES if case.type not in ("SENSOR", "NDARRAY") and case.metadata is None]
#: Beside the cases of ``peers``: those that a program without metadata and with one number type can send.
FLOATS = [0.5, -1.25, 3.0]
LAYOUT = {"dim": [{"label": "", "size": 3, "stride": 3}], "data_offset": 0}
MORE = [
    Case(
        "SENSOR",
        "Torque",
        struct.pack(">BBQ3d", 3, 0, 0, *FLOATS),
        {"values": ("std_msgs/msg/Float64MultiArray", {"layout": LAYOUT, "data": FLOATS})},
    ),
    Case(
        "NDARRAY",
        "Line",
        struct.pack(">BBH3f", 10, 1, 3, *FLOATS),
        {"float32_array": ("std_msgs/msg/Float32MultiArray", {"layout": LAYOUT, "data": FLOATS})},
    ),
]

HEARD = {case.topic(what): kind for case in MORE for what, (kind, _) in case.heard.items()}


def judge(kind: Kind, command: list[str], folder: Path) -> list[Row]:
    rows: list[Row] = []
    for is_server in kind.roles:
        recording = folder / f"{'server' if is_server else 'client'}.mcap"
        options = ("--record", str(recording), *kind.options)
        with world(Implementation(command), is_server, *options, subscribed=HEARD) as place:
            if kind.queries:
                rows += _queries(place)
            rows += [_in(kind, place, case) for case in [*SENT, *MORE] if case.type in kind.sends]
            rows += [_out(kind, place, one) for one in OUTGOING if one.type in kind.reads]
        rows += _verified(recording)
    return results.summed(rows)


def _in(kind: Kind, place: Place, case: Case) -> Row:
    content = describe_content(decode(packed(case.type, case.device, case.content)).content)
    if case.type == "IMAGE":
        content |= {"data_hex": case.content[HEAD_BYTES:].hex()}
    fault = kind.fault(case.type, case.device, TO_ROS)
    place.peer.send(case.type, case.device, content, SEC, FRAC)
    with suppress(TimeoutError):
        text = place.peer.receive("error", None, _ERROR_S)["text"]
        return Row(case.type, TO_ROS, DIFFERS if fault else CANNOT, 1, fault or f"{case.device}: {text}"[:300])
    for what, (_, wanted) in case.heard.items():
        try:
            got = _heard(place, case.topic(what))
            while what == "tf" and children(got) != children(wanted):
                got = _heard(place, case.topic(what))
        except AssertionError as error:
            return _wrong(fault, case, str(error), TO_ROS)
        if stamped(got, kind.stamp) != stamped(wanted, kind.stamp):
            return _wrong(fault, case, f"{what} has {got}, expected {wanted}", TO_ROS)
    return Row(case.type, TO_ROS, EXACT, 1, fault and "")


def _heard(place: Place, topic: str) -> Any:
    place.node.wait_until(lambda: bool(place.node.waiting(topic)), f"message on {topic}", _RECEIVE_S)
    return place.node.receive(topic)


def stamped(value: Any, nanosec: int | None) -> Any:
    """The message with the stamp that the program can have sent: without one, any."""
    if isinstance(value, dict):
        if set(value) == {"sec", "nanosec"}:
            return {} if nanosec is None else value | {"nanosec": nanosec} if value["nanosec"] == NANOSEC else value
        # a server in Rust adds metadata
        return {key: stamped(one, nanosec) for key, one in value.items() if key != "metadata"}
    return [stamped(one, nanosec) for one in value] if isinstance(value, list) else value


def _wrong(fault: str, what: Case | Sent, text: str, direction: str) -> Row:
    if fault:
        return Row(what.type, direction, DIFFERS, 1, fault)
    return Row(what.type, direction, FAILS, 1, f"{what.device}: {' '.join(text.split())}"[:500])


def _out(kind: Kind, place: Place, one: Sent) -> Row:
    fault = kind.fault(one.type, one.device, TO_IGTL)
    place.node.publish(one.topic, one.fields)
    try:
        got = place.peer.receive(kind.instead.get(one.type, one.type), one.device, _RECEIVE_S)
        if one.type in kind.instead:
            return Row(f"{one.type} as {kind.instead[one.type]}", TO_IGTL, EXACT)
        wanted = only(one.content, got["content"])  # it does not show everything
        assert got["content"], "it shows nothing"
        try:
            check(got["content"], wanted)
        except AssertionError:
            raise AssertionError(f"{got['content']}, expected {wanted}") from None
    except (AssertionError, TimeoutError, PeerError, KeyError) as error:
        return _wrong(fault, one, f"{type(error).__name__} {error}", TO_IGTL)
    return Row(one.type, TO_IGTL, EXACT)


def _queries(place: Place) -> Iterator[Row]:
    """A GET_ for what there is, and for what there is not; a stream of tracking data."""
    pose = {"translation": {"x": 0.1, "y": 0.2, "z": 0.3}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    frame = {"header": head("Base"), "child_frame_id": "Tool", "transform": pose}
    for what, wanted in (("nothing", "STATUS"), ("what there is", "TRANSFORM")):
        place.peer.write(["GET_TRANS", "=Any", "0"])
        try:
            got = place.peer.receive(wanted, None, _RECEIVE_S)
            assert got["content"], "no content"
            yield Row(f"GET_TRANS of {what}: {wanted}", BOTH, EXACT)
        except (AssertionError, TimeoutError) as error:
            yield Row(f"GET_TRANS of {what}", BOTH, FAILS, 1, f"{error}"[:300])
        place.node.publish("/igtl/out/ToolToBase", frame)
        place.peer.receive("TRANSFORM", "ToolToBase", _RECEIVE_S)
    place.peer.write(["STT_TDATA", "=", "0", "50"])
    try:
        place.peer.receive("RTS_TDATA", None, _RECEIVE_S)
        later = head("Base") | {"stamp": {"sec": SEC + 1, "nanosec": 0}}
        place.node.publish("/igtl/out/ToolToBase", frame | {"header": later})
        place.peer.receive("TDATA", None, _RECEIVE_S)
        yield Row("STT_TDATA of 8 bytes: poses as TDATA", BOTH, EXACT)
    except (AssertionError, TimeoutError) as error:
        yield Row("STT_TDATA of 8 bytes", BOTH, FAILS, 1, f"{error}"[:300])
    place.peer.forget()


def _verified(recording: Path) -> Iterator[Row]:
    for options in ((), ("--reference",)):
        command = [sys.executable, "-m", "igtl_gateway", "verify", *options, str(recording)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        text = "" if done.returncode == 0 else (done.stdout + done.stderr)[-300:]
        yield Row("recording: verify" + "".join(f" {one}" for one in options), BOTH, FAILS if text else EXACT, 1, text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=KINDS)
    parser.add_argument("--classes", help="class path of a library in Java")
    parser.add_argument("--python", help="interpreter that has the package")
    parser.add_argument("--program", help="path of a program that speaks the lines of foreign_peers.py")
    parser.add_argument("--sources", help="folder of a sender for MATLAB, for Octave with the package sockets")
    parser.add_argument("--version", required=True, help="of the implementation: its release or commit")
    options = parser.parse_args()
    kind = KINDS[options.name]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = judge(kind, kind.made(options, folder), folder)
    return results.write(
        options.name,
        kind.program,
        options.version,
        "client and server" if len(kind.roles) > 1 else "server" if kind.roles[0] else "client",
        rows,
    )


if __name__ == "__main__":
    sys.exit(main())
