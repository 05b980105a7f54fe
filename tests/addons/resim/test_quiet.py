"""Programs that do less than they did: silence, another QoS and callbacks that do not return are no success."""

from __future__ import annotations

import json
import re
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.reading import Qos
from igtl_gateway.addons.resim.api import resim
from igtl_gateway.cli import main
from tests.addons.resim import sessions
from tests.addons.resim.runs import judged, program
from tests.addons.resim.sessions import Row, message

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]

TEXT = "std_msgs/msg/String"


def recording(path: Path, *, qos: Qos | None = None, also: tuple[str, ...] = ()) -> Path:
    """What ``quiet.py all`` received and published; topics ``also`` are of other nodes."""
    texts = sessions.texts(40)
    outputs: list[Row] = []
    for number, (ns, topic, _, content) in enumerate(texts, 1):
        if topic == "/in":
            outputs.append((ns, "/out", TEXT, content))
            outputs.append((ns, "/state", TEXT, message(TEXT, data=str(number))))
            outputs += [(ns, name, TEXT, content) for name in also]
    offered = {"/out": qos} if qos else {}
    return sessions.write_both(path, texts, outputs, qos=offered)


@pytest.mark.parametrize(
    ("what", "line"),
    [
        ("all", "1 run; equal to in.mcap"),
        ("silent", "DIFFERENT from in.mcap in 1 of 2 streams (1 run): /state: no program published a message of it"),
        ("without", "1 run; equal to in.mcap; recorded, but published by no program: /state"),
    ],
)
def test_silence_on_a_recorded_output_is_a_difference(tmp_path: Path, what: str, line: str) -> None:
    _, verdict = judged(
        recording(tmp_path / "in.mcap"), tmp_path, f"quiet {what}", runs=1, reference=tmp_path / "in.mcap"
    )
    assert verdict.line() == line
    assert verdict.exit_code == (1 if what == "silent" else 0)
    if what == "silent":
        (silent,) = [each for each in verdict.streams if not each.is_equal]
        assert (silent.stream, silent.messages, silent.other_messages, silent.missing) == ("/state", 40, 0, 40)


def test_silence_in_json_and_in_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recording(tmp_path / "in.mcap")
    command = [*program("quiet", "silent").command]
    assert main(["resim", str(path), "--runs", "1", "--json", "--", *command]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert (facts["exit_code"], facts["first"]) == (1, {"stream": "/state", "what": "silent"})
    (silent,) = [each for each in facts["streams"] if not each["equal"]]
    assert (silent["stream"], silent["missing"]) == ("/state", 40)
    found = resim(path, command, runs=1)
    assert not found.is_equal
    assert found.first and (found.first.stream, found.first.what) == ("/state", "silent")


@pytest.mark.parametrize(
    ("options", "near"),
    [(["--output", "/zzz"], ""), (["--without", "/inn"], "/in")],
)
def test_a_topic_with_a_mistake_cannot_be_judged(
    tmp_path: Path, options: list[str], near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, command = recording(tmp_path / "in.mcap"), [*program("quiet", "all").command]
    words = ["resim", str(path), "--runs", "1", *options]
    assert main([*words, "--json", "--", *command]) == 2
    facts = json.loads(capsys.readouterr().out)
    fault, (one,) = facts["fault"], facts["runs"]
    assert fault.startswith(f"{' '.join(options)}: matches no topic of the recording or of a program") and near in fault
    assert ("/state" in one["outputs"]) is (options[0] == "--without"), "an output is judged before the first message"
    wrong = options[1]
    outputs, without = ((wrong,), ()) if options[0] == "--output" else ((), (wrong,))
    found = resim(path, command, runs=1, outputs=outputs, without=without)
    assert not found.is_equal and options[1] in str(found)
    with pytest.raises(GatewayError, match=r"--input /inn: matches no recorded topic; did you mean '/in'\?"):
        resim(path, command, inputs="/inn")


@pytest.mark.parametrize(("wrong", "near"), [("/rosuot", "/rosout"), ("/stat", "/state")])
def test_an_output_that_is_nearly_a_recorded_topic_is_refused_before_the_programs_start(
    tmp_path: Path, wrong: str, near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path, begun = recording(tmp_path / "in.mcap"), tmp_path / "begun"
    command = [sys.executable, "-c", f"open({str(begun)!r}, 'w')"]
    text = f"--output {wrong}: matches no topic of the recording; did you mean {near!r}?"
    assert main(["resim", str(path), "--output", wrong, "--", *command]) == 2
    assert text in " ".join(capsys.readouterr().err.split())
    with pytest.raises(GatewayError, match=re.escape(text)):
        resim(path, command, outputs=wrong)
    assert not begun.exists()


def test_a_topic_that_is_there_may_be_named_without_need(tmp_path: Path) -> None:
    path, command = recording(tmp_path / "in.mcap"), [*program("quiet", "all").command]
    assert resim(path, command, runs=1, without="/in", outputs=["/rosout", "/st*"], inputs="/in").is_equal


def test_a_baseline_with_an_output_that_is_silent_now(tmp_path: Path) -> None:
    path = recording(tmp_path / "in.mcap")
    (good := tmp_path / "good").mkdir()
    judged(path, good, "quiet all", runs=1)
    for what, text in (
        ("silent", "/state: no program published a message of it"),
        ("without", "/state: no program published a message of it"),
        ("deep", "/out: its QoS is reliable, volatile, depth 10 and reliable, volatile, depth 50"),
    ):
        _, verdict = judged(path, tmp_path, f"quiet {what}", runs=1, reference=good / "run-1.mcap")
        assert verdict.exit_code == 1 and text in verdict.line(), what


@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("best_effort", "/out: its QoS is reliable, volatile and best effort, volatile"),
        ("latched", "/out: its QoS is reliable, volatile and reliable, transient local"),
        ("deep", ""),  # the recording has the depth of a subscription
    ],
)
def test_another_qos_is_a_difference(tmp_path: Path, what: str, text: str) -> None:
    path = recording(tmp_path / "in.mcap", qos=Qos(100, reliable=True))
    _, verdict = judged(path, tmp_path, f"quiet {what}", runs=1, reference=path)
    assert verdict.exit_code == (1 if text else 0) and text in verdict.line()


@pytest.mark.parametrize(
    ("what", "fault"),
    [
        ("sleeps", "quiet: a callback did not return: it sleeps at the end of the session, for a year and more"),
        ("awaits", "quiet: a callback did not return: it sleeps at the end of the session, for 12 days more"),
        ("rests", ""),
        ("apart", ""),
    ],
)
def test_a_callback_that_sleeps_for_ever_is_no_success(tmp_path: Path, what: str, fault: str) -> None:
    path = recording(tmp_path / "in.mcap")
    result, verdict = judged(path, tmp_path, f"quiet {what}", runs=1, reference=path)
    assert verdict.fault == fault
    assert verdict.exit_code == (2 if fault else 0)
    assert result.runs[0].streams["/out"].messages == 40


def test_a_callback_of_a_pool_that_sleeps_for_ever_is_a_remark(tmp_path: Path) -> None:
    """Other threads go on beside it: nothing waits for it."""
    path = recording(tmp_path / "in.mcap")
    result, _ = judged(path, tmp_path, "quiet pools", runs=1, reference=path)
    assert "quiet: a thread sleeps at the end of the session, for a year and more" in result.runs[0].remarks
