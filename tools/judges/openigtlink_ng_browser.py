"""The WebSocket client of openigtlink-ng in Chromium, as a headset: poses at 60 Hz and VP9 at 30 Hz, both ways.

``python tools/judges/openigtlink_ng_browser.py --program FOLDER --version COMMIT``: a copy of openigtlink-ng in which a
person has built ``core-ts/dist/browser.mjs`` (npm run build).  Chromium must be there.  Writes
docs/evidence/real-programs/openigtlink-ng-browser.jsonl; exit code 1 if anything differs.

Strategy: a page (``programs/ng_headset.html``) sends and receives with their classes; a foreign ROS node receives all,
sends poses, and sends each frame back.  Each pose is compared as numbers, each frame by its SHA-256.  The bridge is
recorded, and verified with and without the fast path.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.cli import main as gateway
from tests.addons.page.browser import Browser, site
from tests.integration.bridge import TIMEOUT_S, Bridge, RosClient
from tools.judges import results
from tools.judges.results import BOTH, EXACT, FAILS, TO_IGTL, TO_ROS, Row

PAGE = Path(__file__).with_name("programs") / "ng_headset.html"
POSE, IMAGE = "geometry_msgs/msg/TransformStamped", "sensor_msgs/msg/CompressedImage"
POSES_IN, FRAMES_IN = "/igtl/in/Headset/transform", "/igtl/in/Eye/compressed_image"
POSES_OUT, FRAMES_OUT = "/igtl/out/Tool", "/igtl/out/Scene"
HZ = 60


def row(what: str, direction: str, found: list[Any], wanted: list[Any]) -> Row:
    """The comparison of two lists."""
    if found == wanted:
        return Row(what, direction, EXACT, len(wanted))
    same = sum(one == other for one, other in zip(found, wanted, strict=False))
    return Row(what, direction, FAILS, len(wanted), f"{len(found)} came, the first {same} are equal")


def run(program: Path, seconds: int) -> list[Row]:
    """Play; return the rows."""
    poses, frames = HZ * seconds, HZ * seconds // 2
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        recording = folder / "headset.mcap"
        bridge = Bridge("--record", str(recording), "--listen", "ws://127.0.0.1:0")
        stack.callback(bridge.close)
        (started,) = bridge.wait_events(lambda event: event["event"] == "started", "start")
        port = started["listen"][1]["port"]
        outgoing = {POSES_OUT: POSE, FRAMES_OUT: IMAGE}
        node = RosClient("judge", subscribe={POSES_IN: POSE, FRAMES_IN: IMAGE}, advertise=outgoing)
        stack.callback(node.close)
        node.wait_readers(POSES_OUT, FRAMES_OUT)
        place = stack.enter_context(site({"": PAGE, "browser.mjs": program / "core-ts" / "dist" / "browser.mjs"}))
        browser = stack.enter_context(Browser())
        browser.open(f"http://localhost:{place}/?port={port}&poses={poses}&frames={frames}")
        browser.wait("state.connected")
        begun, sent = time.monotonic(), 0
        back: list[Any] = []
        turn = {"rotation": {"w": 1.0}}
        while sent < poses or len(back) < frames:
            if sent < min(poses, (time.monotonic() - begun) * HZ):
                place_of = {"transform": {"translation": {"x": sent / 1000, "y": 0.25, "z": 0.5}} | turn}
                node.publish(POSES_OUT, place_of)
                sent += 1
            elif node.waiting(FRAMES_IN):
                back.append(node.receive(FRAMES_IN))
                node.publish(FRAMES_OUT, {"format": "vp9", "data": back[-1]["data"]})
            elif time.monotonic() - begun > seconds + TIMEOUT_S:
                break
            else:
                time.sleep(0.002)
        browser.wait("state.done")
        browser.wait(f"state.frames.length >= {frames} && state.poses.length >= {poses}")
        state = browser.run("state")
        received = [node.receive(POSES_IN)["transform"]["translation"] for _ in range(poses)]
        browser.run("client.close()")  # a page that is only left keeps its connection
        (up,) = bridge.wait_events(lambda event: event.get("code") == "link_up", "link")
        bridge.wait_code("link_down", links=up["links"])
        result = bridge.end()
        verified = [gateway(["verify", str(recording), *words]) for words in ((), ("--reference",))]
    hashes = [hashlib.sha256(bytes.fromhex(each["data"]["hex"])).hexdigest() for each in back]
    numbers = [[round(each[axis] * 1000, 4) for axis in "xyz"] for each in received]
    matrices = [[1, 0, 0, 0, 1, 0, 0, 0, 1, number, 250, 500] for number in range(poses)]
    wanted = [0, [], [0, 0], "websocket"]
    found = [result.code, state["errors"] + browser.complaints, verified, up["data"]["transport"]]
    return [
        row("TRANSFORM, 60 Hz", TO_ROS, numbers, [[number, 2, 3] for number in range(poses)]),
        row("VIDEO (VP9), 30 Hz", TO_ROS, hashes, state["sent"]),
        row("TRANSFORM, 60 Hz", TO_IGTL, [[round(x, 3) for x in each] for each in state["poses"]], matrices),
        row("VIDEO (VP9), 30 Hz", TO_IGTL, state["frames"], state["sent"]),
        row("recorded, verified, also with --reference; no error in the page", BOTH, [found], [wanted]),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, required=True)
    parser.add_argument("--version", required=True)
    parser.add_argument("--seconds", type=int, default=20)
    options = parser.parse_args()
    rows = run(options.program, options.seconds)
    role = "client over WebSocket, in Chromium"
    return results.write("openigtlink-ng-browser", "openigtlink-ng, TypeScript", options.version, role, rows)


if __name__ == "__main__":
    sys.exit(main())
