"""OpenIGTLink programs of others as client and as server of the gateway: pyigtl, and the C++ library in Debian.

``python tools/judges/peers.py pyigtl`` or ``library``.  Writes docs/evidence/real-programs/NAME.jsonl; exit code 1 if
anything is not exact.

Strategy: the peer encodes what it sends and decodes what it receives with its own code; a rclpy node at the gateway's
other side is as in ``ros_types``, with the same messages.  What a peer has no class for is left out.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.bridge import TIMEOUT_S, Bridge, RosClient
from tests.integration.test_ros_types import (
    ADVERTISED,
    CASES,
    NINTHS,
    OUTGOING,
    SEC,
    SUBSCRIBED,
    Case,
    Sent,
    check,
    children,
    packed,
    rows_of_the_command_line,
)
from tests.peers import PeerError, only, pyigtl_peer, reference
from tests.peers.pyigtl_peer import PyigtlPeer
from tests.peers.reference import ReferencePeer
from tools.judges import results
from tools.judges.results import CANNOT, DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row

#: In units of 2⁻³² s.
FRAC = NINTHS << 23
HEAD_BYTES = 72  # of the content of an IMAGE


@dataclass(frozen=True)
class Kind:
    """A program of others.

    Attributes:
        types: what it has a class for.
    """

    program: str
    version: Callable[[], str]
    peer: Any
    types: Collection[str]


def debian(package: str) -> str:
    asked = ["dpkg-query", "-W", "-f", "${Version}", package]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout


KINDS = {
    "pyigtl": Kind("pyigtl", lambda: version("pyigtl"), PyigtlPeer, pyigtl_peer.CODECS.keys()),
    "library": Kind(
        "OpenIGTLink library of Debian", lambda: debian("libopenigtlink1.11"), ReferencePeer, reference.ENCODERS.keys()
    ),
}


@dataclass(frozen=True)
class Place:
    node: RosClient
    peer: Any


@contextmanager
def world(
    peer: Any, is_server: bool, *options: str, subscribed: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Place]:
    """The bridge, with further options, between a rclpy node, with further subscriptions, and the peer."""
    with ExitStack() as stack:
        node = stack.enter_context(RosClient("judge", subscribe=SUBSCRIBED | dict(subscribed), advertise=ADVERTISED))
        server = stack.enter_context(peer.server()) if is_server else None
        words = ["--connect", f"127.0.0.1:{server.port}"] if server else []
        bridge = Bridge("--no-cautious", *rows_of_the_command_line(), *words, *options)
        stack.callback(bridge.close)
        stack.callback(bridge.end)
        other = server or stack.enter_context(peer.client("127.0.0.1", bridge.port))
        bridge.wait_code("link_up")
        node.wait_readers(*ADVERTISED)
        yield Place(node, other)


def judge(kind: Kind) -> list[Row]:
    rows = []
    for is_server in (False, True):
        with world(kind.peer, is_server) as place:
            rows += [_in(place, case) for case in CASES if case.type in kind.types]
            rows += [_out(place, one) for one in OUTGOING if one.type in kind.types]
    return results.summed(rows)


def _in(place: Place, case: Case) -> Row:
    if case.metadata is not None:
        return Row(case.type, TO_ROS, CANNOT, 1, "metadata: it sends header version 1")
    content = describe_content(decode(packed(case.type, case.device, case.content)).content)
    if case.type == "IMAGE":
        content |= {"data_hex": case.content[HEAD_BYTES:].hex()}
    try:
        place.peer.send(case.type, case.device, content, SEC, FRAC)
    except (PeerError, ValueError) as error:
        return Row(case.type, TO_ROS, CANNOT, 1, str(error))
    result, text = EXACT, ""
    for what, (_, wanted) in case.heard.items():
        try:
            got = place.node.receive(case.topic(what))
            while what == "tf" and children(got) != children(wanted):
                got = place.node.receive(case.topic(what))
        except AssertionError as error:
            return Row(case.type, TO_ROS, FAILS, 1, " ".join(str(error).split())[:300])
        if without_nanoseconds(got) != without_nanoseconds(wanted):
            return Row(case.type, TO_ROS, FAILS, 1, f"{case.device}: {what} has {got}, expected {wanted}")
        if got != wanted:
            result, text = DIFFERS, "a time inside the content by some nanoseconds: its rule of conversion, not ours"
    return Row(case.type, TO_ROS, result, 1, text)


def without_nanoseconds(value: Any) -> Any:
    """The message without the last digits of times: the library of Debian rounds them by a rule of its own."""
    if isinstance(value, dict):
        return {key: one // 100 if key == "nanosec" else without_nanoseconds(one) for key, one in value.items()}
    return [without_nanoseconds(one) for one in value] if isinstance(value, list) else value


def _out(place: Place, one: Sent) -> Row:
    place.node.publish(one.topic, one.fields)
    try:
        got = place.peer.receive(one.type, one.device, TIMEOUT_S)
        check(got["content"], only(one.content, got["content"]))  # it does not show everything
        assert got.get("crc_ok", True), "wrong CRC"
    except (AssertionError, TimeoutError, KeyError) as error:
        return Row(one.type, TO_IGTL, FAILS, 1, f"{one.device}: {type(error).__name__} {error}"[:600])
    return Row(one.type, TO_IGTL, EXACT)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=KINDS)
    name = parser.parse_args().name
    kind = KINDS[name]
    return results.write(name, kind.program, kind.version(), "client and server", judge(kind))


if __name__ == "__main__":
    sys.exit(main())
