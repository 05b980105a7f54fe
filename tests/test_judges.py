"""The results of the judges of real programs, and their page."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.wire import decode
from igtl_gateway.wire.registry import describe_content
from tests.integration.bridge import RosClient
from tests.integration.test_ros_types import packed
from tests.peers import only
from tools.judges import cisst, plus, rclcpp
from tools.judges.foreign import SENT
from tools.judges.foreign_peers import CODECS
from tools.judges.page import page
from tools.judges.peers import HEAD_BYTES
from tools.judges.results import DIFFERS, EXACT, FAILS, TO_IGTL, TO_ROS, Row, summed, write


def test_only_exact_rows_without_a_remark_are_summed() -> None:
    one = Row("IMAGE", TO_ROS, EXACT)
    differs, fails = Row("IMAGE", TO_ROS, DIFFERS, text="a digit"), Row("IMAGE", TO_IGTL, FAILS)
    assert summed([one, differs, one, fails]) == [Row("IMAGE", TO_ROS, EXACT, 2), differs, fails]


def test_a_judge_fails_if_anything_differs_and_the_page_shows_how(tmp_path: Path) -> None:
    rows = [Row("IMAGE", TO_ROS, EXACT, 3), Row("IMAGE", TO_IGTL, EXACT)]
    assert write("fine", "Fine", "1.0", "client", rows, tmp_path) == 0
    assert (
        write("wrong", "Wrong", "2.0", "server", [*rows, Row("STRING", TO_ROS, DIFFERS, 1, "a|b, theirs")], tmp_path)
        == 1
    )
    head = json.loads((tmp_path / "wrong.jsonl").read_text("utf-8").splitlines()[0])
    shown = page(tmp_path)
    assert f"| Wrong | 2.0 | server | 4 | 1 | 0 | 0 | {head['date']} | `{head['commit']}` | {head['load']} |" in shown
    assert "| IMAGE | exact (3) | exact (1) |" in shown
    assert r"| STRING | differs (1): a\|b, theirs |  |" in shown


def test_the_sequence_of_the_judge_of_plus_is_what_it_compares_with() -> None:
    head, _, data = plus.sequence().partition(b"ElementDataFile = LOCAL\n")
    lines = dict(line.split(" = ") for line in head.decode().splitlines())
    size = plus.WIDTH * plus.HEIGHT
    for number in range(plus.FRAMES):
        assert plus.NUMBERS[data[number * size : (number + 1) * size].hex()] == number
        for name in plus.POSES[:2]:
            matrix = list(map(float, lines[f"Seq_Frame{number:04d}_{name}Transform"].split()))
            assert plus.close(matrix, plus.WANTED[name](number).ravel())
            assert lines[f"Seq_Frame{number:04d}_{name}TransformStatus"] == plus.status(name, number)
    assert {plus.status("ProbeToReference", number) for number in range(plus.FRAMES)} == {
        "OK",
        "OUT_OF_VIEW",
        "INVALID",
    }


def test_a_pose_that_is_turned_the_other_way_is_not_equal() -> None:
    there = {axis: value / 1000 for axis, value in zip("xyz", (-4, 7.25, 1), strict=True)}
    turn = {"x": -0.004999812382094068, "y": -0.009999625229901814, "z": -0.009999625229901814, "w": 0.9998875021054452}
    assert plus.is_pose({"translation": there, "rotation": turn}, plus.reference(1))
    assert not plus.is_pose({"translation": there, "rotation": {**turn, "w": -turn["w"]}}, plus.reference(1))


def test_what_the_judge_of_cisst_sends_is_what_it_expects_back() -> None:
    for number in (1, 7):
        assert cisst.is_pose(cisst.pose_command(number), number)
        assert not cisst.is_pose(cisst.pose_command(number), number + 1)
        assert cisst.six(cisst.force_command(number)["wrench"], "force", "torque") == cisst.force(number)
    assert cisst.by_stamp({"header": {"stamp": {"sec": cisst.BEGIN_S + 1, "nanosec": 750_000_000}}}) == 7


class Reports(RosClient):
    """Components that report as long as the judge waits, the last image last."""

    def __init__(self) -> None:
        numbers = range(1, rclcpp.MESSAGES + 1)
        self.coming = [f"{kind} {number}" for kind in ("pose", "text") for number in numbers]
        self.coming += [f"image {number} same" for number in numbers]
        self.there: list[str] = []

    def received(self, topic: str) -> list[dict[str, str]]:
        return [{"data": each} for each in self.there]

    def wait_until(self, done: Callable[[], bool], what: str, *_: float) -> None:
        while not done():
            self.there.append(self.coming.pop(0))


def test_the_judge_of_rclcpp_waits_for_the_last_image() -> None:
    assert [row.result for row in rclcpp._between(Reports())] == [EXACT]


def test_the_words_of_a_content_for_a_foreign_peer_are_that_content() -> None:
    seen = set()
    for case in SENT:
        if case.type not in CODECS or case.type == "POINT":  # of which programs show the position only
            continue
        content = describe_content(decode(packed(case.type, case.device, case.content)).content)
        content["data_hex"] = case.content[HEAD_BYTES:].hex()
        write_words, read_words = CODECS[case.type]
        words = write_words(content)
        assert not any(set(word) & set(" \n") or not word for word in words)
        found = read_words(words)
        assert only(content, found) == found and found
        seen.add(case.type)
    assert seen == {"TRANSFORM", "POSITION", "STRING", "STATUS", "IMAGE", "TDATA", "CAPABILITY"}
