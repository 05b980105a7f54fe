"""TRAJ: the bytes of a path, and its description."""

from __future__ import annotations

from igtl_gateway.wire.trajectory import ENTRY_AND_TARGET, ENTRY_ONLY, TARGET_ONLY, Trajectories
from tests.wire.contents import check_golden, check_list, element, f32, text


def test_a_list_holds_whole_elements() -> None:
    check_list(Trajectories, 150)


def test_golden_bytes() -> None:
    described = check_golden(
        element(Trajectories, "t", "g", ENTRY_AND_TARGET, 0, [1, 2, 3, 4], [1, 2, 3], [4, 5, 6], 2.5, "ct"),
        text("t", 64) + text("g", 32) + b"\3\0\1\2\3\4" + f32(1, 2, 3, 4, 5, 6, 2.5) + text("ct", 20),
        lambda size: size == 0,
    )
    assert described["elements"] == [
        {
            "name": "t",
            "group": "g",
            "type": 3,
            "rgba": [1, 2, 3, 4],
            "entry": [1, 2, 3],
            "target": [4, 5, 6],
            "diameter": 2.5,
            "owner": "ct",
        }
    ]


def test_kinds_are_those_of_the_document() -> None:
    assert (ENTRY_ONLY, TARGET_ONLY, ENTRY_AND_TARGET) == (1, 2, 3)
