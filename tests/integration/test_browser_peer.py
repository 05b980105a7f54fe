"""The example of a browser as a peer, in Chromium: poses both ways, by a relay to a plain server."""

from __future__ import annotations

import socket
import struct

import pytest

from tests.addons.page.browser import CHROMIUM, Browser, site
from tests.integration.bridge import Bridge, RawPeer, extended, message
from tests.places import ROOT

EXAMPLES = ROOT / "examples" / "peers"


@pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")
def test_poses_go_both_ways_and_a_page_that_is_left_disconnects() -> None:
    pose = struct.pack(">12f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 10.25, -20.5, 30)
    with socket.create_server(("127.0.0.1", 0)) as server:
        to = f"127.0.0.1:{server.getsockname()[1]}"
        bridge = Bridge("--relay", "--listen", "ws://127.0.0.1:0", "--connect", to, listen=False)
        try:
            (started,) = bridge.wait_events(lambda event: event["event"] == "started", "start")
            port = started["listen"][0]["port"]
            pages = {each.name: each for each in (EXAMPLES / "browser.html", EXAMPLES / "openigtlink.mjs")}
            with site(pages) as place, Browser() as browser:
                browser.open(f"http://localhost:{place}/?at=ws://127.0.0.1:{port}")
                browser.wait("document.querySelector('#state').textContent.startsWith('connected')")
                peer = RawPeer.__new__(RawPeer)
                peer.socket = server.accept()[0]
                peer.send(message("TRANSFORM", pose, device="Tool"))
                peer.send(message("TRANSFORM", extended(pose, {"frame_id": "base"}), device="Tool2", version=2))
                browser.wait("document.querySelectorAll('#poses tr').length === 2")
                text = browser.text()
                assert "Tool\t10.3\t-20.5\t30.0" in text and "Tool2\t10.3\t-20.5\t30.0" in text
                x, y = browser.run(
                    "(() => { const box = document.querySelector('#field').getBoundingClientRect();"
                    " return [box.x + 41, box.y + 31] })()"
                )
                browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
                wire = peer.receive(device="Pointer")
                assert wire.crc_ok and struct.unpack(">12f", wire.body) == (1, 0, 0, 0, 1, 0, 0, 0, 1, 40, 30, 0)
                assert browser.complaints == []
                browser.open("about:blank")
                bridge.wait_code("link_down", links=[1])
                peer.close()
            assert bridge.end().code == 0
        finally:
            bridge.close()
