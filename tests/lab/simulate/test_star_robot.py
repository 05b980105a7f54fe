"""The robot alone: when it takes over a plan, when it refuses one, and that it waits for the approval."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.rosmsg import Header, Marker, String, TransformStamped
from igtl_gateway_lab.simulate import star_topics as topics
from igtl_gateway_lab.simulate.actor import RosReceived, RosSent
from igtl_gateway_lab.simulate.star_arm import SHAFT, to_camera
from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.star_robot import SutureRobot
from igtl_gateway_lab.simulate.star_scene import StarScene
from igtl_gateway_lab.simulate.star_tissue import STITCHES
from tests.lab.simulate.star_truth import length

START_NS = 10**18
APPROVED = RosReceived(topics.SAID, String.TYPE, String("plan approved").pack())


class Played:
    """A robot that receives messages, and everything it sends."""

    def __init__(self, seconds: float = 20.0) -> None:
        self.robot = SutureRobot(round(seconds * NS_PER_S))
        self.robot.begin(START_NS)
        self.said: list[RosSent] = []
        self.now_ns = START_NS

    def receive(self, heard: RosReceived) -> None:
        self.said += [word for word in self.robot.receive(self.now_ns, heard) if isinstance(word, RosSent)]

    def play(self, seconds: float) -> None:
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        while self.robot.due_ns is not None and self.robot.due_ns <= end_ns:
            self.now_ns = self.robot.due_ns
            self.said += [word for word in self.robot.act(self.now_ns) if isinstance(word, RosSent)]
        self.now_ns = end_ns

    def see(self, scene: StarScene) -> None:
        """The first cloud comes, and the plan is drawn."""
        frame = scene.cloud(0, scene.rest, SHAFT)
        cloud = topics.coloured_cloud(Header(self.now_ns), frame.points, frame.rgb)
        self.receive(RosReceived(topics.CLOUD, cloud.TYPE, cloud.pack()))
        self.play(0.5)

    def correct(self, points: Array) -> None:
        cloud = topics.plain_cloud(Header(self.now_ns), points)
        self.receive(RosReceived(topics.CORRECTED, cloud.TYPE, cloud.pack()))
        self.play(0.1)

    def plans(self) -> list[Array]:
        plans = [said.message for said in self.said if said.topic == topics.PLAN]
        return [
            plan.points.reshape(-1, 2, 3).swapaxes(0, 1).reshape(-1, 3) for plan in plans if isinstance(plan, Marker)
        ]

    def status(self) -> str:
        last = [said.message for said in self.said if said.topic == topics.STATUS][-1]
        assert isinstance(last, String)
        return last.data

    def tips(self) -> Array:
        poses = [said.message for said in self.said if isinstance(said.message, TransformStamped)]
        return to_camera(np.array([pose.translation for pose in poses if pose.child_frame_id == topics.TOOL_FRAME]))


@pytest.fixture
def play(scene: StarScene) -> Played:
    made = Played()
    made.play(0.1)
    made.see(scene)
    return made


def test_without_a_cloud_there_is_no_plan_and_no_approval(scene: StarScene) -> None:
    play = Played(1.0)
    play.play(0.1)
    play.receive(APPROVED)
    play.correct(np.zeros((2 * STITCHES, 3)))
    assert play.status() == "plan: correction refused, there is none yet"
    play.play(2.0)
    assert play.plans() == [] and play.robot.done and not play.robot.report().good
    assert length(play.tips() - scene.rest).max() < 1e-4


def test_a_correction_is_taken_over_and_repeated(play: Played) -> None:
    points = play.plans()[-1].copy()
    points[13] += [0.0, 0.0, 0.0015]
    play.correct(points)
    np.testing.assert_allclose(play.plans()[-1], points, atol=2e-8)
    assert play.status() == "plan: corrected by the planner: exit of stitch 3 by 1.5 mm"


def test_a_list_of_another_length_is_refused(play: Played) -> None:
    play.correct(play.plans()[-1][:-1])
    assert play.status() == "plan: correction refused, found 21 points, expected 22"
    assert len(play.plans()) == 1


def test_the_arm_moves_after_the_approval_along_the_plan_in_force_and_takes_no_other(
    play: Played, scene: StarScene
) -> None:
    points = play.plans()[-1].copy()
    points[0] += [0.0, 0.0, 0.001]
    play.correct(points)
    play.receive(RosReceived(topics.SAID, String.TYPE, String("not yet").pack()))
    play.play(2.0)
    assert length(play.tips() - scene.rest).max() < 1e-4
    play.receive(APPROVED)
    play.play(1.0)
    play.correct(play.plans()[0])
    assert play.status() == "plan: correction refused, the arm is at work"
    play.receive(APPROVED)  # again: nothing is repeated
    play.play(2.5)
    assert length(play.tips() - points[0]).min() < 1e-4
    assert length(play.tips() - points[STITCHES]).min() < 1e-4
    assert length(play.tips() - play.plans()[0][0]).min() > 5e-4


def test_a_robot_that_was_not_told_to_begin_says_so(play: Played) -> None:
    play.play(30.0)
    report = play.robot.report()
    assert not report.good and not report.facts["approved"] and report.facts["executed"] == 0
    assert "not approved" in report.lines[-1]
