"""Which words of a command line are for ROS."""

from __future__ import annotations

import pytest

from igtl_gateway.cli import main
from igtl_gateway.cli.ros_arguments import without_ros_arguments


@pytest.mark.parametrize(
    ("words", "own", "ros"),
    [
        ("bridge --listen :1", "bridge --listen :1", ""),
        ("bridge --ros-args -r a:=b", "bridge", "--ros-args -r a:=b"),
        ("bridge --ros-args -r a:=b -- --listen :1", "bridge --listen :1", "--ros-args -r a:=b"),
        ("bridge --ros-args", "bridge", "--ros-args"),
        ("bridge --ros-args -r a:=b -- x --ros-args -p c:=d", "bridge x", "--ros-args -r a:=b --ros-args -p c:=d"),
        ("bridge -- x", "bridge -- x", ""),
    ],
)
def test_parts(words: str, own: str, ros: str) -> None:
    assert without_ros_arguments(words.split()) == (own.split(), ros.split())


@pytest.mark.parametrize("words", ["replay x.mcap --to ros --ros zenoh", "bridge --ros-a -r a:=b"])
def test_a_beginning_of_the_option_takes_nothing(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """`replay --ros zenoh` had passed ``zenoh`` to a node of DDS."""
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert "found the beginning of --ros-args, expected all of it" in capsys.readouterr().err
