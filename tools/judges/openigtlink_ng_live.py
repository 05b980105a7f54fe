"""The clients and the servers of openigtlink-ng in Python and TypeScript, with a bridge that records.

``python tools/judges/openigtlink_ng_live.py --program FOLDER --python PATH``: as ``openigtlink_ng``, without C++.
Writes docs/evidence/real-programs/openigtlink-ng-python.jsonl and -typescript.jsonl; exit code 1 if anything differs.

Strategy: ``programs/ng_peer`` sends values through its own client or server, and shows those that it receives; a rclpy
node at the gateway's other side is as in ``ros_types``, with the same messages.  The recording must verify, by the full
path too.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.wire import Header, decode, describe
from tests.integration.bridge import Bridge, Program, RosClient, gateway
from tests.integration.test_ros_types import (
    ADVERTISED,
    CASES,
    OUTGOING,
    SUBSCRIBED,
    Case,
    Sent,
    check,
    children,
    packed,
    rows_of_the_command_line,
)
from tests.peers import only
from tools.judges import results
from tools.judges.ng_values import words_of
from tools.judges.openigtlink_ng import PROGRAMS, SCHEMAS, TYPESCRIPT, arguments, parsed, schemas_of, version_of
from tools.judges.results import BOTH, CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

RECORDED = "recorded, and verifies"


class Peer(Program):
    """The program, by its lines."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self.events: list[dict[str, Any]] = []
        super().__init__(["env", "-C", str(folder), *command], stdin=subprocess.PIPE)

    def take(self, line: str) -> None:
        self.events.append(json.loads(line))

    def send(self, words: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(words.encode() + b"\n")
        self.process.stdin.flush()

    def event(self, key: str) -> Any:
        """What the next event with this key has for it."""
        return self.next(lambda event: key in event, key)[key]

    def message(self, kind: str, device: str) -> dict[str, Any]:
        """The next message of a type and a name, or the next error."""

        def is_it(event: dict[str, Any]) -> bool:
            header = Header.unpack(memoryview(bytes.fromhex(event["data"]))) if "data" in event else None
            return "refused" in event or (header is not None and (header.type, header.device_name) == (kind, device))

        self.wait_until(lambda: any(map(is_it, self.events)) or bool(self.stderr()), f"{kind} {device}")
        if any(map(is_it, self.events)):
            return self.next(is_it, f"{kind} {device}")
        return {"refused": self.stderr().partition("\n")[0]}  # the server in TypeScript has no handler of errors

    def next(self, wanted: Any, what: str) -> dict[str, Any]:
        self.wait_until(lambda: any(map(wanted, self.events)), what)
        return self.events.pop(next(at for at, event in enumerate(self.events) if wanted(event)))


@dataclass(frozen=True)
class Place:
    node: RosClient
    peer: Peer


@dataclass(frozen=True)
class Kind:
    """A language of openigtlink-ng.

    Attributes:
        command: of its program, without the role.
        folder: of openigtlink-ng.
        types: what it has a schema for.
    """

    command: Sequence[str]
    folder: Path
    types: frozenset[str]


@contextmanager
def world(kind: Kind, is_server: bool, recording: Path) -> Iterator[Place]:
    """The bridge between a rclpy node and the peer; the recording is verified at the end."""
    with ExitStack() as stack:
        node = stack.enter_context(RosClient("judge", subscribe=SUBSCRIBED, advertise=ADVERTISED))
        words, where = ["--no-cautious", "--record", str(recording), *rows_of_the_command_line()], []
        if is_server:
            peer = Peer([*kind.command, "server"], kind.folder)
            stack.callback(peer.close)
            where = ["--connect", f"127.0.0.1:{peer.event('port')}"]
        bridge = Bridge(*words, *where)
        stack.callback(bridge.close)
        if not is_server:
            peer = Peer([*kind.command, "client", str(bridge.port)], kind.folder)
            stack.callback(peer.close)
        bridge.wait_code("link_up")
        peer.event("connected")
        node.wait_readers(*ADVERTISED)
        yield Place(node, peer)
        bridge.end()


def judge(kind: Kind) -> list[Row]:
    rows = []
    for is_server in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder) / "session.mcap"
            with world(kind, is_server, recording) as place:
                rows += [_tried(case.type, TO_ROS, _in, place, case) for case in CASES if case.type in kind.types]
                outgoing = sorted((one for one in OUTGOING if one.type in kind.types), key=_is_refused)
                rows += [_tried(one.type, TO_IGTL, _out, place, one) for one in outgoing]
            rows += [_verified(recording), _verified(recording, "--reference")]
    return results.summed(rows)


def _is_refused(one: Sent) -> bool:
    """These come last: the server in Python closes the link, and gets kept ones again when it is there again."""
    return not json.dumps(one.content, ensure_ascii=False).isascii()


def _tried(what: str, direction: str, run: Any, place: Place, one: Any) -> Row:
    try:
        return run(place, one)
    except (AssertionError, KeyError, BrokenPipeError) as error:
        return Row(what, direction, FAILS, 1, " ".join(f"{one}: {type(error).__name__} {error}".split())[:300])


def _in(place: Place, case: Case) -> Row:
    if case.metadata is not None:
        return Row(case.type, TO_ROS, CANNOT, 1, "metadata: its clients and servers send header version 1")
    place.peer.send(words_of(decode(packed(case.type, case.device, case.content))))
    if why := place.peer.event("sent"):
        return Row(case.type, TO_ROS, CANNOT, 1, _reason(why))
    for what, (_, wanted) in case.heard.items():
        got = place.node.receive(case.topic(what))
        while what == "tf" and children(got) != children(wanted):
            got = place.node.receive(case.topic(what))
        assert got == wanted, f"{what} has {got}, expected {wanted}"
    return Row(case.type, TO_ROS, EXACT)


def _out(place: Place, one: Sent) -> Row:
    place.node.publish(one.topic, one.fields)
    found = place.peer.message(one.type, one.device)
    if "refused" in found:
        return Row(one.type, TO_IGTL, DIFFERS, 1, _reason(found["refused"]))
    data = bytes.fromhex(found["data"])
    content = describe(data)["content"]
    check(content, only(one.content, content))
    assert found["words"] == words_of(decode(data)), f"it shows {found['words']}"
    return Row(one.type, TO_IGTL, EXACT)


def _reason(text: str) -> str:
    return "it refuses text that is not ASCII: its rule" if "ascii" in text.lower() else text[:300]


def _verified(recording: Path, *words: str) -> Row:
    program = gateway("verify", str(recording), *words)
    result = program.end(None)
    program.close()
    what = " ".join([RECORDED, *words])
    return Row(what, BOTH, FAILS, 1, result.out[-300:]) if result.code else Row(what, BOTH, EXACT)


def main() -> int:
    given = parsed(arguments(__doc__), SCHEMAS | TYPESCRIPT)
    schemas = given.program / "spec" / "schemas"
    types = frozenset(schemas_of(given.program))
    commands = {
        "Python": [str(given.python), str(PROGRAMS / "ng_peer.py"), str(schemas)],
        "TypeScript": ["node", str(PROGRAMS / "ng_peer.mjs"), str(schemas), str(given.program / "core-ts" / "dist")],
    }
    codes = []
    for name, command in commands.items():
        rows = judge(Kind(command, given.program, types))
        program = f"openigtlink-ng in {name}"
        judged = f"openigtlink-ng-{name.lower()}"
        codes.append(results.write(judged, program, version_of(given.program), "client and server", rows))
    return max(codes)


if __name__ == "__main__":
    sys.exit(main())
