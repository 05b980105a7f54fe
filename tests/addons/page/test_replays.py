from __future__ import annotations

import time
from collections.abc import Callable

from igtl_gateway.addons.page.replays import Replay
from tests.integration.bridge import RawPeer, free_port
from tests.places import FIXTURES
from tests.timing import WAIT_S


def wait(condition: Callable[[], object]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_replay_is_steered() -> None:
    replay, port = Replay(), free_port()

    def state(name: str) -> float:
        facts = replay.facts()
        return float(facts["state"].get(name) or 0) if facts else 0

    assert replay.facts() is None and replay.steer("play", None) == (False, "no replay runs")
    how = {"to": "igtl", "address": f"127.0.0.1:{port}", "paused": True}
    assert replay.start("lego.mcap", FIXTURES / "lego.mcap", how)[0]
    wait(lambda: state("duration_s"))
    assert replay.start("lego.mcap", FIXTURES / "lego.mcap", how)[1] == "the replay of lego.mcap runs; stop it first"
    assert state("paused") and not state("sent")
    with RawPeer(port) as peer:
        replay.steer("seek", 20.0)
        replay.steer("rate", 5)
        replay.steer("play", None)
        assert peer.receive(type_name="TRANSFORM").device
        wait(lambda: state("position_s") > 20 and state("rate") == 5)
        for value in (float("nan"), float("inf"), -5, 10**30, True, None, "1", [1]):
            assert not replay.steer("seek", value)[0] and not replay.steer("rate", value)[0]
        facts = replay.facts()
        assert facts and facts["to"] == "igtl" and facts["place"] == f"127.0.0.1:{port}"
        (client,) = facts["state"]["peers"]
        assert client["peer"].startswith("127.0.0.1:") and client["queued"] == 0
        for name in ("rate_hz", "sent"):
            wait(lambda name=name: (replay.facts() or {})["state"]["peers"][0][name] > 1)  # type: ignore[misc]
        assert replay.steer("stop", None)[0]
        wait(lambda: not (replay.facts() or {})["running"])


def test_what_cannot_be_replayed() -> None:
    replay = Replay()
    for how in (
        {"to": "x"},
        {"role": "x"},
        {"address": "h:99999"},
        {"rate": "fast"},
        {"rate": [1]},
        {"rate": float("nan")},
    ):
        assert not replay.start("lego.mcap", FIXTURES / "lego.mcap", how)[0]
    assert replay.start("none.mcap", FIXTURES / "none.mcap", {})[0]
    wait(lambda: (replay.facts() or {})["failed"])
    assert "none.mcap" in " ".join((replay.facts() or {})["lines"])
    assert replay.steer("jump", None)[1].startswith("found 'jump'")


def test_what_plays_without_a_peer_is_not_sent_and_the_end_is_the_last_position() -> None:
    replay = Replay()
    how = {"address": f"127.0.0.1:{free_port()}", "rate": 1000}
    assert replay.start("lego.mcap", FIXTURES / "lego.mcap", how)[0]
    wait(lambda: "messages were sent" in " ".join((replay.facts() or {})["lines"]))
    facts = replay.facts() or {}
    assert facts["lines"][-1].startswith("0 messages were sent, and ")
    assert facts["lines"][-1].endswith(" while no peer was connected")
    assert facts["state"]["sent"] == 0 < facts["state"]["without_peer"]
    assert facts["state"]["position_s"] == facts["state"]["duration_s"] > 0
