"""The whole story offline, what can go wrong in it, and that what is sent fits together in space."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.igtl_msgs import LabeledPoint, PointList, Volume
from igtl_gateway.convert.poses import rotation_matrix
from igtl_gateway.convert.rosmsg import Header, Marker, RosMessage, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, text
from igtl_gateway.wire.polydata import Cells, PolyData
from igtl_gateway_lab.simulate import lego, lego_arm, lego_planner, lego_world
from igtl_gateway_lab.simulate import lego_terms as terms
from igtl_gateway_lab.simulate.actor import Actor, ActorReport, RosReceived, RosSent
from igtl_gateway_lab.simulate.lego_arm import skeleton_of
from igtl_gateway_lab.simulate.lego_planner import LegoPlanner
from igtl_gateway_lab.simulate.lego_robot import TICK_NS, LegoRobot
from igtl_gateway_lab.simulate.lego_sheet import HEIGHT_MM, on_sheet
from igtl_gateway_lab.simulate.registration import Rigid
from igtl_gateway_lab.simulate.stage import play_offline
from igtl_gateway_lab.simulate.volume import LESION, synthetic_head

HEAD = synthetic_head(8.0)


@pytest.fixture(scope="module")
def story() -> tuple[list[Entry], dict[str, ActorReport]]:
    cast = lego.actors(None, HEAD)
    log = list(play_offline(cast, lego.CONFIG))
    return log, {actor.name: actor.report() for actor in cast}


def heard(log: Iterable[Entry], topic: str, message: type[Any]) -> list[Any]:
    """Messages of a topic, whichever side they came from."""
    kinds = (Kind.ROS_IN, Kind.ROS_OUT)
    return [message.unpack(entry.data()) for entry in log if entry.channel == topic and entry.kind in kinds]


def rigid_of(pose: TransformStamped) -> Rigid:
    """In metres."""
    return Rigid(np.array(rotation_matrix(pose.rotation)), np.array(pose.translation))


def test_it_ends_well_and_in_its_time(story: tuple[list[Entry], dict[str, ActorReport]]) -> None:
    log, reports = story
    assert all(report.good for report in reports.values()), reports
    assert (log[-1].stamp_ns - log[0].stamp_ns) / NS_PER_S == pytest.approx(lego.LENGTH_S, abs=1)
    notes = [Note.unpack(entry.data()) for entry in log if entry.kind is Kind.NOTE]
    assert all(note.level < Level.WARN for note in notes), notes


def test_the_figures_of_the_report(story: tuple[list[Entry], dict[str, ActorReport]]) -> None:
    planner, robot = story[1]["planner"], story[1]["lego_robot"]
    facts = planner.facts
    assert 0.5 < facts["fre_mm"] < 1.5, "a toy"
    assert facts["fre_mm"] == pytest.approx(np.sqrt(np.mean(np.square(list(facts["residuals_mm"].values())))), abs=0.01)
    assert facts["tre_mm"] == pytest.approx(facts["expected_check_mm"], rel=0.5) and facts["expected_tre_mm"] < 0.8
    assert max(facts["checks_mm"].values()) < lego_planner.MAX_TRE_MM
    assert facts["stops"] == 11, "a rest, nine crosses, a rest"
    line = facts["line_mm"]
    assert 0.2 < line["mean"] < 1.0 < line["largest"] <= line["hausdorff"] < 2.5
    assert line["drawn"] == pytest.approx(line["planned"], rel=0.05)
    assert robot.facts["error_of_registration_mm"] < facts["tre_mm"], "a check is touched with an error, too"
    assert robot.facts["gaps"] == 0 and robot.facts["volume"] == list(HEAD.size)
    assert any("FRE 1.01" in line and "worst" in line for line in planner.lines), planner.lines


def test_everything_lies_in_one_space(story: tuple[list[Entry], dict[str, ActorReport]]) -> None:
    log, _ = story
    (volume,) = heard(log, "/igtl/in/HeadMR/volume", Volume)
    landmarks, plan, ink = (
        heard(log, "/igtl/in/Landmarks/landmarks", PointList)[0],
        heard(log, "/igtl/in/DrawingPlan/lines", Marker)[0],
        heard(log, terms.INK_TOPIC, Marker)[-1],
    )
    for message in (volume, landmarks, plan, ink):
        assert message.header.frame_id == terms.IMAGE
    i, j, k = np.rint((LESION / 1000 - volume.origin) / volume.spacing).astype(int)
    width, height, _ = volume.size
    assert volume.data[(k * height + j) * width + i] > 200, "the lesion of the image is where the plan leads"
    assert np.abs(plan.points.mean(0) - LESION / 1000).max() < 0.012
    assert np.abs(ink.points[:, 2] - HEIGHT_MM / 1000).max() < 1e-6
    assert np.abs(ink.points.mean(0) - plan.points.mean(0)).max() < 0.002

    poses = heard(log, "/igtl/in/HeadImageToLegoBase/transform", TransformStamped)
    assert {(pose.header.frame_id, pose.child_frame_id) for pose in poses} == {(terms.BASE, terms.IMAGE)}
    guess, final = rigid_of(poses[0]), rigid_of(poses[-1])
    pens = heard(log, terms.PEN_TOPIC, TransformStamped)
    assert {(pen.header.frame_id, pen.child_frame_id) for pen in pens} == {(terms.BASE, terms.PEN)}
    tips = np.array([pen.translation for pen in pens])

    def nearest(where: Rigid) -> list[float]:
        """How near the pen has come to each cross, mm."""
        crosses = where.apply(np.array([point.position for point in landmarks.points]))
        return [1000 * float(np.linalg.norm(tips - cross, axis=1).min()) for cross in crosses]

    assert max(nearest(final)) < 1.0
    assert max(nearest(guess)) > 5.0, "without the registration the pen passes the crosses by"
    drawn = final.apply(ink.points[len(ink.points) // 2])
    assert 1000 * np.linalg.norm(tips - drawn, axis=1).min() < 3.0, "ink is where the pen was"


def test_arm_and_joints_and_pen_tell_the_same(story: tuple[list[Entry], dict[str, ActorReport]]) -> None:
    log, _ = story
    arms, pens = heard(log, terms.ARM_TOPIC, Marker), heard(log, terms.PEN_TOPIC, TransformStamped)
    joints = heard(log, terms.JOINTS_TOPIC, JointState)
    by_stamp = {pen.header.stamp_ns: (pen, joint) for pen, joint in zip(pens, joints, strict=True)}
    for arm in arms[::10]:
        pen, joint = by_stamp[arm.header.stamp_ns]
        assert joint.header.stamp_ns == arm.header.stamp_ns and arm.header.frame_id == terms.BASE
        assert arm.points[-1] == pytest.approx(pen.translation, abs=2e-6)
        assert arm.points == pytest.approx(skeleton_of(tuple(joint.position)), abs=2e-6)
    assert np.diff([pen.header.stamp_ns for pen in pens]).tolist() == [TICK_NS] * (len(pens) - 1)


@pytest.mark.parametrize("seconds", [27.0, 500.0, float("nan")])
def test_a_length_that_cannot_be(seconds: float) -> None:
    with pytest.raises(ConfigError, match=r"duration of lego: found .* s, expected 27.75 … 370 s"):
        lego.actors(seconds, HEAD)


def test_an_arm_without_errors_draws_what_was_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    """So whatever a line is off is the toy's: image, units, frames, wire and registration add nothing."""
    fine = tuple(replace(joint, gear=10_000, play_deg=0.0) for joint in lego_arm.JOINTS)
    monkeypatch.setattr(lego_arm, "JOINTS", fine)
    monkeypatch.setattr(lego_world, "_EYE_MM", 0.0)
    cast = lego.actors(29.0, HEAD)
    log = list(play_offline(cast, lego.CONFIG))
    assert (log[-1].stamp_ns - log[0].stamp_ns) / NS_PER_S == pytest.approx(29, abs=1.5), "and it can go faster"
    planner, robot = (actor.report().facts for actor in cast)
    assert planner["fre_mm"] < 0.03 and planner["tre_mm"] < 0.03 and robot["error_of_registration_mm"] < 0.03
    assert planner["line_mm"]["hausdorff"] < 0.1, "the camera's tenth of a millimetre"


def test_ink_of_any_form_is_understood() -> None:
    planner = LegoPlanner(HEAD)
    planner.begin(0)
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], ">f4")
    none, strip = PolyData(points), PolyData(points, lines=Cells.of([[0, 1, 2]]))
    for content in (none, strip):
        assert list(planner.receive(1, Message("POLYDATA", terms.INK_DEVICE, content))) == []
    (words,) = planner.receive(2, Message("STRING", terms.STATUS_DEVICE, text.String.of("drawn 2 segments")))
    assert isinstance(words.content, text.String) and words.content.text.startswith("result: line off by")


# -- What can go wrong -------------------------------------------------------------------------------------------------


def run(*cast: Actor) -> list[ActorReport]:
    list(play_offline(cast, lego.CONFIG, limit_s=60))
    assert all(actor.done for actor in cast), "it ends by itself"
    return [actor.report() for actor in cast]


def test_a_plan_out_of_reach_is_refused_and_everybody_goes_home(monkeypatch: pytest.MonkeyPatch) -> None:
    far = {"far": np.array([[0.0, 0, HEIGHT_MM], [200, 0, HEIGHT_MM]])}
    monkeypatch.setattr(lego_planner, "strokes", lambda: far)
    planner, robot = run(LegoPlanner(HEAD), LegoRobot())
    assert not planner.good and not robot.good
    assert "result: the robot refused: pen to (" in planner.lines[-1], planner.lines
    assert "mm from the shoulder to the wrist, expected less than 304 mm" in robot.lines[-1]


def test_a_cross_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lego_planner, "LANDMARKS", {"nose": (0.0, 0.0), "chin": (9.0, 9.0), "ear": (5.0, 0.0)})
    planner, robot = run(LegoPlanner(HEAD), LegoRobot())
    assert "there is no cross 'nose' on the sheet" in planner.lines[-1]
    assert not robot.good and robot.facts["touched"] == 0


def test_stops_that_are_too_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lego_planner, "_SHORTEST_S", 5.0)
    planner, robot = run(LegoPlanner(HEAD), LegoRobot())
    assert "registration: found 0 stops of the tool, expected 9, one a landmark" in planner.lines[-1]
    assert not planner.good and not robot.good


def test_a_mirrored_sheet_fits_as_well_and_is_refused_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lego_planner, "on_sheet", lambda crosses: on_sheet(crosses) * (-1, 1, 1))
    planner, robot = run(LegoPlanner(HEAD), LegoRobot())
    assert "found the sheet face down, expected face up; left taken for right?" in planner.lines[-1]
    assert not planner.good and robot.facts["segments"] == 0, "nothing is drawn on the wrong side"


def said(words: Iterable[RosSent]) -> list[str]:
    return [word.message.data for word in words if isinstance(word.message, String)]


def ros(topic: str, message: RosMessage) -> RosReceived:
    return RosReceived(topic, message.TYPE, message.pack())


def test_points_without_a_registration_are_refused() -> None:
    robot = LegoRobot()
    robot.begin(0)
    point = LabeledPoint("1", "a", (0, 0, 0, 255), (0.0, 0.0, 0.02), 0.0, "")
    words = robot.receive(1, ros("/igtl/in/DrawingPoints/landmarks", PointList(Header(), (point, point))))
    assert said(words)[-1] == "refused: points came without a registration"


def test_a_registration_that_comes_again_is_no_new_one() -> None:
    robot = LegoRobot()
    robot.begin(0)
    topic = "/igtl/in/HeadImageToLegoBase/transform"
    first = TransformStamped(Header(), "", (0.21, 0.0, -0.02), (0.0, 0.0, 0.0, 1.0))
    assert "registered 1" in said(robot.receive(1, ros(topic, first)))
    assert said(robot.receive(2, ros(topic, first))) == []
    other = TransformStamped(Header(), "", (0.22, 0.0, -0.02), (0.0, 0.0, 0.0, 1.0))
    assert said(robot.receive(3, ros(topic, other))) == ["registered 2"]


def test_a_list_that_is_empty_asks_for_nothing_and_a_dot_is_a_stroke() -> None:
    robot = LegoRobot()
    robot.begin(0)
    pose = TransformStamped(Header(), "", (0.2126, 0.0183, -0.0198), (0.0, 0.0, 0.0698, 0.9976))
    assert "registered 1" in said(robot.receive(1, ros("/igtl/in/HeadImageToLegoBase/transform", pose)))
    for device in ("Landmarks", "DrawingPoints"):
        assert said(robot.receive(2, ros(f"/igtl/in/{device}/landmarks", PointList(Header(), ())))) == []
    dot = LabeledPoint("1", "dot", (0, 0, 0, 255), (0.036, -0.048, 0.02), 0.0, "")
    words = said(robot.receive(3, ros("/igtl/in/DrawingPoints/landmarks", PointList(Header(), (dot, dot, dot)))))
    assert words == ["drawing 1 stroke through 3 points"]
    for tick in range(200):
        words += said(robot.act(tick * TICK_NS))
    assert words[1:] == ["drawn 0 segments"]
