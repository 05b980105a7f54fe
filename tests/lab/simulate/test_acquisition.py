"""The exchange of Figure 9: its order, and that the planner sees what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.rosmsg import Image, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway_lab.simulate.acquisition import AcquisitionPlanner, AcquisitionRobot, actors
from igtl_gateway_lab.simulate.actor import Actor, RosSent, Sent
from igtl_gateway_lab.simulate.stage import play_offline


def played(*cast: Actor) -> list[Entry]:
    return list(play_offline(cast, Config(), limit_s=30.0))


def test_the_six_steps_in_their_order() -> None:
    cast = actors(1.5)
    log = played(*cast)
    crossed = [entry.channel for entry in log if entry.kind in (Kind.IGTL_IN, Kind.IGTL_OUT)]
    steps = [stream for at, stream in enumerate(crossed) if at == 0 or crossed[at - 1] != stream]
    assert steps == [
        "STRING/Planner",  # 1. INITIALIZE
        "STRING/Robot",  # INITIALIZED
        "POINT/Target",  # 2.
        "STRING/Robot",  # MOVING
        "TRANSFORM/ProbeToBase",  # 3. poses on the way
        "STRING/Robot",  # AT TARGET
        "COMMAND/Probe",  # 4. Acquire
        "RTS_COMMAND/Probe",
        "TRANSFORM/ProbeToBase",  # 5. where the image was taken
        "IMAGE/Probe",
        "STRING/Planner",  # 6. SHUT DOWN
        "STRING/Robot",
    ]
    planner, robot = (actor.report() for actor in cast)
    assert planner.good and robot.good
    assert planner.facts["steps"] == 6 and planner.facts["target_error_mm"] == 0.0
    assert planner.facts["lesion_off_centre_mm"] < 0.1


class Liar(AcquisitionRobot):
    """A robot some of whose words are changed on the way, or lost."""

    def __init__(self, change: Callable[[RosSent], RosSent | None]) -> None:
        super().__init__(0.2)
        self._change = change

    def act(self, now_ns: int) -> Iterable[Sent]:
        changed = (self._change(said) for said in super().act(now_ns) if isinstance(said, RosSent))
        return [said for said in changed if said is not None]


def off(said: RosSent) -> RosSent:
    """The same message with its position one millimetre off."""
    if not isinstance(said.message, TransformStamped):
        return said
    x, y, z = said.message.translation
    return replace(said, message=replace(said.message, translation=(x + 0.001, y, z)))


def shifted(said: RosSent) -> RosSent:
    """An image of somewhere else: four rows further."""
    if not isinstance(said.message, Image):
        return said
    data = bytes(said.message.data)
    return replace(said, message=replace(said.message, data=data[640:] + data[:640]))


def late(said: RosSent) -> RosSent:
    """An image with a stamp of its own."""
    if not isinstance(said.message, Image):
        return said
    header = said.message.header
    return replace(said, message=replace(said.message, header=replace(header, stamp_ns=header.stamp_ns + 1)))


def lost(said: RosSent) -> RosSent | None:
    """No image."""
    return None if isinstance(said.message, Image) else said


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (off, "step 3: found the probe 1.000 mm off"),
        (shifted, "step 5: found the lesion 2.00 mm off"),
        (late, "step 5: found no pose with the stamp of the image"),
        (lost, "step 5: no IMAGE within 5 s"),
    ],
)
def test_the_planner_finds_what_is_wrong_and_shuts_the_robot_down(
    change: Callable[[RosSent], RosSent | None], fault: str
) -> None:
    planner, robot = AcquisitionPlanner(), Liar(change)
    played(planner, robot)
    report = planner.report()
    assert not report.good and planner.done
    assert any(line.startswith(fault) for line in report.lines), report.lines
    if change is lost:
        assert robot.done, "it was shut down"


class Overtaken(AcquisitionRobot):
    """Between its poses and whatever belongs to them lies a ROS graph: the poses come last."""

    def act(self, now_ns: int) -> Iterable[Sent]:
        return sorted(
            super().act(now_ns), key=lambda said: isinstance(getattr(said, "message", None), TransformStamped)
        )


def test_what_overtakes_its_pose_waits_for_it() -> None:
    planner, robot = AcquisitionPlanner(), Overtaken(0.2)
    log = played(planner, robot)
    streams = [entry.channel for entry in log if entry.kind is Kind.IGTL_OUT]
    assert streams.index("IMAGE/Probe") < len(streams) - 1 - streams[::-1].index("TRANSFORM/ProbeToBase")
    assert planner.report().good, planner.report().lines


def test_a_planner_without_a_robot_gives_up() -> None:
    planner = AcquisitionPlanner()
    played(planner)
    assert planner.done
    assert planner.report().lines == ("step 1: no STRING INITIALIZED within 5 s",)
    assert planner.report().facts["steps"] == 0


def test_a_robot_obeys_nothing_before_it_is_initialised() -> None:
    class Hasty(AcquisitionPlanner):
        def begin(self, now_ns: int) -> None:
            super().begin(now_ns)
            self._next(now_ns)  # the first order is forgotten

    planner, robot = Hasty(), AcquisitionRobot(0.2)
    played(planner, robot)
    assert not planner.report().good
    assert "refused /igtl/in/Target/point: not initialised" in robot.report().lines
