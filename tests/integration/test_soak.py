"""``python -m tools.evidence.soak``: 10 s of it, and that its judgement would notice.

The hour is in docs/evidence/soak.md.  This has a tenth of the mixed load, because every test shares two cores with
others; clients connect more often than in the hour.  ``IGTL_GATEWAY_SOAK_S`` makes it longer or shorter.
"""

from __future__ import annotations

import copy
import faulthandler
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import pytest

from tests.integration.bridge import SECOND_DOMAIN, environment
from tests.tables import table
from tools.evidence import soak_guests, soak_judge
from tools.evidence.soak_findings import Found, Settings
from tools.evidence.soak_judge import judge, trend

#: How long; half of it is waiting.
SECONDS = float(os.environ.get("IGTL_GATEWAY_SOAK_S", "10"))
SCALE = 0.1
#: What memory may grow by, in the last two thirds of the time.
GROWTH_MB = 20.0


@pytest.mark.slow
def test_load_with_guests_that_come_and_go(tmp_path: Path) -> None:
    words = ["--seconds", f"{SECONDS}", "--scale", f"{SCALE}", "--part-s", f"{SECONDS / 2}", "--guest-s", "1.5"]
    command = [sys.executable, "-m", "tools.evidence.soak", *words, "--growth-mb", f"{GROWTH_MB}"]
    command += ["--folder", str(tmp_path / "soak")]
    env = environment(ROS_DOMAIN_ID=str(SECOND_DOMAIN), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    faulthandler.cancel_dump_traceback_later()  # the suite's: this has a deadline of its own
    done = subprocess.run(
        command, env=env, capture_output=True, text=True, timeout=SECONDS + 300, cwd=tmp_path, check=False
    )
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n--- stderr:\n{done.stderr[-3000:]}"
    told = json.loads((tmp_path / "soak/soak.json").read_text())
    assert told["good"]
    assert all(check["good"] for check in told["checks"])
    # it was no idle minute
    assert sum(told["guests"].values()) > SECONDS / 6
    assert told["notes"]["INFO link_up"] == told["notes"]["INFO link_down"] > SECONDS / 6
    assert all(row["delivered"] > 0.9 * row["sent"] > 0 for row in told["passages"])
    assert sum(part["equal"] for part in told["parts"]) > 100 * SECONDS
    assert "<svg" in (tmp_path / "soak/soak.svg").read_text()
    assert not list((tmp_path / "soak").rglob("*.mcap")), "parts that verify are deleted"


# -- the judgement ---------------------------------------------------------------------------------------------------


def test_the_line_is_that_of_what_stays() -> None:
    rng = Random(1)
    at_s = [5.0 * index for index in range(720)]
    queues = [rng.choice((0.0, 0.0, 0.0, 80.0)) for _ in at_s]
    assert abs(trend(at_s, [300 + queue + rng.random() for queue in queues])) < 2
    grows = [300 + queue + at / 3600 * 30 for at, queue in zip(at_s, queues, strict=True)]
    assert trend(at_s, grows) == pytest.approx(30, abs=2)
    with pytest.raises(ValueError, match="expected some more"):
        trend([1.0], [2.0])


def _process(rss_mb: float) -> dict[str, Any]:
    return {"rss_mb": rss_mb, "anon_mb": rss_mb / 2, "shared_mb": rss_mb / 2, "threads": 28, "fds": 35, "cpu_s": 1.0}


def _good() -> tuple[Settings, Found]:
    """What a soak without any fault finds."""
    settings = Settings(3600, 1, Path("soak"), 1.0, 60.0, 5.0, 4.0, 20.0, 35.0, False)
    sample = {"gateway": _process(300), "recorder": _process(60), "queued_messages": 0}
    found = Found(
        samples=[copy.deepcopy(sample) | {"at_s": 5.0 * index} for index in range(720)],
        baseline=copy.deepcopy(sample),
        end=copy.deepcopy(sample),
        passages=[{"stream": "transform", "direction": "ros-to-igtl", "sent": 10, "delivered": 9, "last": 1.0}],
        parts=[
            {"good": True, "code": 0, "inputs": 4, "outputs": 6, "equal": 6, "lost": 0, "missing": 0, "orphans": 0}
            | {"late": 0}
        ],
        stopped={
            "ledger": {"streams": {"ros_in": {"/a": {"received": 4, "converted": 4}}}},
            "counts": {"ros_in": 4, "igtl_out": 6},
            "recording": {"entries": 10, "dropped": 0, "failure": "", "files": ["soak_0.mcap", "metadata.yaml"]},
        },
    )
    found.guests.update([*(f"{manner}, reset" for manner in soak_guests.MANNERS), "ROS node, killed"])
    return settings, found


def test_what_is_as_it_should_be_is_good() -> None:
    assert [check.name for check in judge(*_good()) if not check.good] == []


def _leak(who: str, what: str, per_sample: float) -> Callable[[Found], None]:
    def change(found: Found) -> None:
        for index, sample in enumerate(found.samples):
            sample[who][what] += per_sample * index

    return change


def _at_end(who: str, what: str, more: int) -> Callable[[Found], None]:
    def change(found: Found) -> None:
        found.end[who][what] += more

    return change


def _stopped(*path: str, value: Any) -> Callable[[Found], None]:
    def change(found: Found) -> None:
        at = found.stopped
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value

    return change


@table(
    ("change", "name"),
    [
        (_leak("gateway", "rss_mb", 0.05), "memory (RSS) of the gateway is flat"),
        (_leak("gateway", "anon_mb", 0.05), "private memory of the gateway is flat"),
        (_leak("recorder", "shared_mb", 0.05), "shared memory of the recorder is flat"),
        (_leak("recorder", "fds", 0.01), "fds of the recorder are flat, and return"),
        (_at_end("gateway", "fds", 1), "fds of the gateway are flat, and return"),
        (_at_end("gateway", "threads", soak_judge.WORKERS + 1), "threads of the gateway are flat, and return"),
        (_stopped("ledger", "streams", "ros_in", "/a", "received", value=5), "the ledger closes"),
        (_stopped("ledger", "gaps", value=["to peer 1: …"]), "the ledger closes"),
        (_stopped("recording", "dropped", value=1), "the recording is complete"),
        (_stopped("recording", "failure", value="disk full"), "the recording is complete"),
        (lambda found: found.parts[0].update(good=False), "the recording verifies"),
        (lambda found: found.parts[0].update(inputs=3), "the recording verifies"),
        (lambda found: found.passages[0].update(last=0.64), "every stream arrives to the end"),
        (lambda found: found.guests.pop("deaf, reset"), "short-lived peers of all kinds connected"),
        (lambda found: found.failures.append("the ROS node did not leave"), "no other failure"),
    ],
)
def test_what_is_not_is_named(change: Callable[[Found], object], name: str) -> None:
    settings, found = _good()
    change(found)
    assert [check.name for check in judge(settings, found) if not check.good] == [name]
