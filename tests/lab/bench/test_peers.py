"""Programs by others: who takes part where, and that those which are installed do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway_lab.bench import peers
from igtl_gateway_lab.bench.cases import CASES, BenchStream, Direction
from igtl_gateway_lab.bench.jobs import Job, JobStream
from igtl_gateway_lab.bench.peers import LIBRARY, PEERS, PYIGTL, Library, command, lacks, times_of
from igtl_gateway_lab.bench.processes import BenchError, Program

PART = JobStream(BenchStream("string-100", 200.0), Direction.ROS_TO_IGTL, "/topic", 20)


def test_who_takes_part(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert all("nothing sends mixed" in lacks(peer, CASES["mixed"]) for peer in PEERS)
    assert all("nothing sends cloud-10k" in lacks(peer, CASES["cloud-10k"]) for peer in PEERS)
    monkeypatch.setattr(peers, "find_spec", lambda _name: None)
    assert lacks(PYIGTL, CASES["transform"]) == "pyigtl: not installed"
    monkeypatch.setattr(peers, "_HEADERS", tmp_path)
    assert "libopenigtlink: no" in lacks(LIBRARY, CASES["transform"])


def test_what_cannot_be_compiled_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if lacks(LIBRARY, CASES["transform"]):
        pytest.skip(lacks(LIBRARY, CASES["transform"]))
    broken = tmp_path / "broken.cpp"
    broken.write_text("int main() { return nothing; }\n", "ascii")
    monkeypatch.setattr(peers, "_SOURCE", broken)
    with pytest.raises(BenchError, match=r"libopenigtlink: .*nothing"):
        _ = Library(tmp_path).binary


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    """Compiled once."""
    return Library(tmp_path_factory.mktemp("library"))


@pytest.mark.parametrize(("sender", "listener"), [(LIBRARY, "igtl"), ("igtl", LIBRARY), (PYIGTL, "igtl")])
def test_peers_understand_each_other(sender: str, listener: str, library: Library, tmp_path: Path) -> None:
    for peer in {sender, listener} & set(PEERS):
        if reason := lacks(peer, CASES["string-100"]):
            pytest.skip(reason)
    hears = Job(listener, "listener", (), (PART,), 0.0, str(tmp_path / "heard"), listen=True)
    with Program("listener", command(hears, library)) as hearing:
        place = hearing.wait_for("listening", 60.0)
        sends = Job(sender, "sender", (PART,), (), 0.0, str(tmp_path / "sent"), (place["host"], place["port"]))
        with Program("sender", command(sends, library)) as sending:
            for program in (hearing, sending):
                program.wait_for("ready", 60.0)
            sending.order("knock")
            assert hearing.wait_for("heard", 60.0)["key"] == PART.device
            sending.order("begin")
            assert sending.wait_for("sent", 60.0)["messages"] == PART.count
            arrived = 0
            while arrived < PART.count:
                hearing.order("count")
                arrived = hearing.wait_for("count", 60.0)["messages"]
            sending.end()
            hearing.end()
    told = times_of(sends) | times_of(hears)
    assert list(told[f"numbers {PART.device}"]) == list(range(1, PART.count + 1))
    waited = told[f"received {PART.device}"] - told[f"sent {PART.device}"]
    assert np.all(waited > 0)


def test_a_program_that_wrote_nothing(tmp_path: Path) -> None:
    job = Job("igtl", "client", (PART,), (), 0.0, str(tmp_path / "none"))
    for side in ("igtl", LIBRARY):
        with pytest.raises(BenchError, match="client: wrote no times"):
            times_of(replace(job, side=side))
