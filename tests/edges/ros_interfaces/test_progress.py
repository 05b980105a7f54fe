"""What the standard error shows while packages are compiled."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.ros_interfaces import progress as progress_module
from igtl_gateway.edges.ros_interfaces.progress import Progress
from tests.tables import table

COSTS = {"long_msgs": 15.0, "short_msgs": 5.0}


@pytest.fixture
def bars(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[], list[str]]:
    """Function: what a terminal of 80 columns has shown in its last line."""
    monkeypatch.setattr(progress_module, "_has_cursor", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")

    def shown() -> list[str]:
        first, *texts = capsys.readouterr().err.split("\r\x1b[K")
        assert all(len(text.rstrip("\n")) < 80 for text in (first, *texts))
        return texts

    return shown


def test_a_terminal_has_a_bar_with_an_estimate_by_the_speed_so_far(bars: Callable[[], list[str]]) -> None:
    clock = ManualClock()
    progress = Progress(COSTS, 1, clock)
    progress.show("long_msgs", 0.0)
    clock.advance(30 * NS_PER_S)
    progress.show("long_msgs", 0.4)
    clock.advance(10 * NS_PER_S)
    progress.show("long_msgs", 0.4, 0.2)  # nothing is done, but it goes on
    clock.advance(50 * NS_PER_S)
    progress.show("long_msgs", 0.4, 0.2)
    clock.advance(50 * NS_PER_S)
    progress.show("long_msgs", 0.4, 0.2)  # it takes long
    progress.close()
    assert bars() == [
        "compiling ROS messages [>                   ]   0%",
        "compiling ROS messages [======>             ]  30%, about 1 min 10 s left",
        "compiling ROS messages [========>           ]  40%, about 1 min left",
        "compiling ROS messages [========>           ]  44%, about 1 min 55 s left",
        "compiling ROS messages [========>           ]  44%, about 3 min left",
        "",
    ]


def test_a_share_never_goes_back_and_nothing_is_estimated_before_it_is_known(bars: Callable[[], list[str]]) -> None:
    clock = ManualClock()
    progress = Progress({"long_msgs": 10.0}, 1, clock)
    clock.advance(1000 * NS_PER_S)
    progress.show("long_msgs", 0.05)
    progress.show("long_msgs", 0.01)
    assert bars() == ["compiling ROS messages [=>                  ]   5%"] * 2


def test_elsewhere_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    clock = ManualClock()
    progress = Progress({"long_msgs": 15.0}, 1, clock)
    for number in range(25):
        progress.show("long_msgs", number / 25)
        clock.advance(NS_PER_S)
    progress.close()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "First start: compiling 1 ROS message package, once for this environment."
    assert [line[:50] for line in lines[1:]] == [
        "compiling ROS messages [>                   ]   0%",
        "compiling ROS messages [========>           ]  40%",
        "compiling ROS messages [================>   ]  80%",
    ]


def test_a_closed_standard_error_is_no_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", None)
    Progress(COSTS, 2, ManualClock()).close()


#: Packages as they are; the work on each as rows of parts that are done at the same time.
_PACKAGES = {"a_msgs": 15.0, "b_msgs": 8.0, "c_msgs": 2.0, "d_msgs": 2.0, "e_msgs": 1.5}
_WORK = ((0.07,), (0.07, 0.08, 0.08, 0.08), (0.2, 0.15, 0.12), *[(0.03,)] * 5)


def _left_s(text: str) -> int:
    minutes, seconds = (re.search(rf"([0-9]+) {unit}\b", text.partition("about")[2]) for unit in ("min", "s"))
    return 60 * int(minutes[1] if minutes else 0) + int(seconds[1] if seconds else 0)


@table("processors, busy", [(cpus, busy) for cpus in (1, 2, 4, 8) for busy in ((1.0,), (6.0,), (4.0, 6.0, 5.0, 6.0))])
def test_an_estimate_is_within_a_factor_of_two_on_any_machine(
    processors: int, busy: tuple[float, ...], bars: Callable[[], list[str]]
) -> None:
    """``busy``: how many times longer than alone all takes, in equal parts of the work."""
    clock, step = ManualClock(), 0.25
    progress = Progress(_PACKAGES, processors, clock)
    waiting, running = list(_PACKAGES), list[str]()
    done, whole = dict.fromkeys(_PACKAGES, 0.0), sum(_PACKAGES.values())
    found: list[tuple[float, str]] = []
    now = 0.0
    bars()
    while waiting or running:
        while waiting and len(running) < processors:
            running.append(waiting.pop(0))
        slower = busy[int(len(busy) * sum(done.values()) / whole * 0.999)]
        clock.advance(int(step * NS_PER_S))
        now += step
        for package in list(running):
            done[package] = min(done[package] + step / slower, _PACKAGES[package])
            share, under_way = _reported(done[package] / _PACKAGES[package])
            progress.show(package, share, under_way)
            found += ((now, text) for text in bars())
            if share == 1.0:
                running.remove(package)
    known = [(now - at, _left_s(text)) for at, text in found if "left" in text]
    assert known[0][0] > 0.7 * now, "it is known early"
    wrong = [each for each in known if each[0] > 0.1 * now and not 0.5 <= each[1] / each[0] <= 2]
    assert not wrong


def _reported(part: float) -> tuple[float, float]:
    """What a package reports as done and under way at a part of its time."""
    begun = done = 0.0
    for parts in _WORK:
        for each in sorted(parts):  # the shortest ends first
            if part >= begun + sum(min(each, other) for other in parts) - 1e-9:
                done += each
        if part < begun + sum(parts) - 1e-9:
            return done, begun + sum(parts) - done
        begun += sum(parts)
    return 1.0, 0.0
