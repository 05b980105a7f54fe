"""Programs by their commands."""

from __future__ import annotations

from igtl_gateway.addons.resim.engine import Program
from tests.tables import table


@table(
    ("command", "title"),
    [
        ("python planner.py", "planner.py"),
        ("python -u nodes/planner.py fast --level 3", "planner.py"),
        ("python -m robot.planner", "robot.planner"),
        ("ros2 run robot planner --ros-args -p speed:=0.05", "planner"),
        ("./build/planner 7", "planner"),
        ("sleep 100", "sleep"),
    ],
)
def test_titles(command: str, title: str) -> None:
    assert Program(tuple(command.split())).title == title
    assert Program(tuple(command.split()), "mine").title == "mine"
