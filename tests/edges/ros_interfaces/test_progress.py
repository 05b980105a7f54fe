"""What the standard error shows while packages are compiled."""

from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.edges.ros_interfaces import progress as progress_module
from igtl_gateway.edges.ros_interfaces.progress import Progress

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
    progress = Progress(COSTS, 2, clock)
    progress.show("long_msgs", 0.0)
    clock.advance(30 * NS_PER_S)
    progress.show("long_msgs", 0.4)
    progress.show("short_msgs", 1.0)
    clock.advance(10 * NS_PER_S)
    progress.show("short_msgs", 1.0)  # nothing new, but time has passed
    progress.close()
    assert bars() == [
        "compiling ROS messages [>                   ]   0%, about 15 s left",
        "compiling ROS messages [======>             ]  30%, about 70 s left",
        "compiling ROS messages [===========>        ]  55%, about 25 s left",
        "compiling ROS messages [===========>        ]  55%, about 15 s left",
        "",
    ]


def test_a_share_never_goes_back_and_an_estimate_is_never_nothing(bars: Callable[[], list[str]]) -> None:
    clock = ManualClock()
    progress = Progress({"long_msgs": 10.0}, 1, clock)
    clock.advance(1000 * NS_PER_S)
    progress.show("long_msgs", 0.05)
    progress.show("long_msgs", 0.01)
    assert bars() == ["compiling ROS messages [=>                  ]   5%, about 1 s left"] * 2


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
