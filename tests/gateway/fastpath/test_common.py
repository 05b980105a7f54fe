"""The native passage as the fast path sees it: what each knows after messages that the other one passed."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.gateway import guarded_stream
from igtl_gateway.gateway.fastpath import passage_streams
from igtl_gateway.native.passage import is_compiled
from tests.gateway.fastpath.test_passage_streams import counted_by_python, pose, scene, wait_for

pytestmark = pytest.mark.skipif(not is_compiled(), reason="installed without the C part")


def test_what_passes_natively_counts_as_the_last_message_to_its_peers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer that is pinged after a silence gets no ping while poses reach it."""
    with scene(monkeypatch) as here:
        here.connect()
        for number in range(20):
            here.send_ros(pose(number))
        wait_for(lambda: here.native == 1)
        with counted_by_python(here) as handled:
            begun_ns = time.time_ns()
            here.send_ros(pose(20))
            wait_for(lambda: here.received("ros_in") == 21)
        assert handled == []
        here.bridge.hub.tick()
        gateway: Any = here.bridge.gateway
        (peer,) = gateway._peers.all()
        assert peer.last_sent_ns >= begun_ns and peer.sent >= 21


def test_after_a_message_in_python_the_passage_judges_from_there() -> None:
    """A stamp that decreases is seen also if Python has handled the message before it."""
    streams = object.__new__(passage_streams.PassageStreams)
    streams._guards, streams._depending = passage_streams._Guards(), {}
    streams._copies, streams._tries, streams._missing = {}, {}, {}
    watched = guarded_stream.GuardedStream("TRANSFORM/a", 0, watch=True)
    native = streams._guards.of(watched)
    t0_ns = 1_700_000_000 * NS_PER_S
    for number in range(3):
        now_ns = t0_ns + number * NS_PER_MS
        assert watched.judge(now_ns, now_ns) == (False, [])
        assert watched.observe(now_ns, now_ns, None) == []
    streams.handled((1, b"a"), SimpleNamespace(watched=watched))  # type: ignore[arg-type]
    assert native.collect()[0][0] == watched.last_ns == t0_ns + 2 * NS_PER_MS
    assert not native.passes(t0_ns + 3 * NS_PER_MS, t0_ns + NS_PER_MS), "it decreases"
    assert native.passes(t0_ns + 3 * NS_PER_MS, t0_ns + 3 * NS_PER_MS)
