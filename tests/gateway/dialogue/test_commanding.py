"""Commands of ROS to peers: their own time, and the reply where they are not sent."""

from __future__ import annotations

from igtl_gateway.config.configuration import Config
from igtl_gateway.config.settings import MAX_TIMEOUT_S
from igtl_gateway.convert.igtl_msgs import Command, CommandReply
from igtl_gateway.convert.rosmsg import Header
from tests.script import Script
from tests.tables import table

REPLY = "/igtl/in/S/command_reply"


def command(timeout_s: float = 0.0, device: str = "S") -> Command:
    return Command(Header(), device, 9, "Go", 0, "", timeout=timeout_s)


@table(
    "timeout_s, expected_s",
    [
        (0.0, 5.0),
        (-1.0, 5.0),
        (float("nan"), 5.0),
        (0.5, 0.5),
        (MAX_TIMEOUT_S, MAX_TIMEOUT_S),
        (MAX_TIMEOUT_S * 1.001, 5.0),
    ],
)
def test_its_own_time_counts_within_bounds(timeout_s: float, expected_s: float) -> None:
    script = Script(Config(command_timeout_s=5.0))
    script.up(1)
    script.ros("/igtl/out/S/command", command(timeout_s))
    assert script.tick(expected_s * 0.99) == []
    assert script.tick(expected_s * 0.02) == [f"ros {REPLY}", "note command_timeout"]


@table("device", ["", "S"])
def test_the_reply_to_one_that_is_denied_has_the_device_or_the_stream(device: str) -> None:
    script = Script(Config(deny_out=("COMMAND",)))
    script.up(1)
    assert f"ros {REPLY}" in script.ros("/igtl/out/S/command", command(device=device))
    reply = CommandReply.unpack(script.published(REPLY))
    assert (reply.id, reply.status, script.sent()) == (9, CommandReply.FAIL, [])
