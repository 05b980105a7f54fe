"""What robots get in random worlds between guard and middleware; ``tools/evidence/robot_worlds.py`` has more."""

from __future__ import annotations

import os
from collections import Counter

import pytest

from tests.app.robot_world import judged
from tools.evidence.robot_worlds import MUTATIONS

#: Worlds of the gate; IGTL_GATEWAY_WORLDS=10000 has more.
WORLDS = int(os.environ.get("IGTL_GATEWAY_WORLDS", "150"))
#: Mutation → a world that breaks a promise with it.
FOUND = dict(zip(MUTATIONS, (1, 5, 12, 84, 54, 53, 5, 252, 0), strict=True))


@pytest.mark.slow
def test_in_random_worlds_no_robot_gets_a_command_late_or_too_fast() -> None:
    total: Counter[str] = Counter()
    for seed in range(WORLDS):
        broken, counts = judged(seed)
        assert not broken, f"world {seed}: {broken[0]}"
        total += counts
    assert total["worlds with motion"] > WORLDS / 4, total
    seen = {"zenoh", "dds", "dds of Humble", "late robot", "returning robot", "incompatible", "foreign"}
    codes = {"command_unheard", "command_newcomer", "command_late", "command_speed"}
    assert seen | codes <= set(total), "no world has the others"


@pytest.mark.parametrize("name", MUTATIONS)
def test_without_a_part_of_the_guard_at_the_write_a_world_is_broken(name: str) -> None:
    with MUTATIONS[name]():
        broken, _ = judged(FOUND[name])
    assert broken
