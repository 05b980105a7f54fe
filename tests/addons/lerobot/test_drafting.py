"""Which stream gives the rate of a starting recipe, what it costs the others, and what an export reports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot.drafting import draft
from igtl_gateway.addons.lerobot.frames import build
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from tests.addons.lerobot.sessions import Sent, arm, bars, joints, write_session
from tests.tables import table

TOOL, SLOW, FAST, FORCE, JOINTS = "TRANSFORM/ToolToBase", "IMAGE/Slow", "IMAGE/Fast", "SENSOR/Force", "/joint_states"


def content(stream: str, at: float) -> Any:
    kind = stream.partition("/")[0]
    if kind == "TRANSFORM":
        return arm(at, 0)
    if kind == "IMAGE":
        return Image((64, 48, 1), 3, bars(round(at * 100) % 256).tobytes())
    if kind == "STRING":
        return String(f"at {at:.2f}".encode())
    return joints(at) if stream == JOINTS else Sensor(np.array([at, 2 * at]))


def session(path: Path, rates: dict[str, float], seconds: float = 4.0) -> Path:
    every: list[Sent] = [
        (number / rate + 0.001 * place, stream, content(stream, number / rate))
        for place, (stream, rate) in enumerate(rates.items())
        for number in range(round(seconds * rate))
    ]
    return write_session(path, sorted(every, key=lambda each: each[0]))


#: Rates, globs, frames per second, a part of the reason, parts of the costs.
DRAFTS: list[tuple[dict[str, float], list[str], int, str, list[str]]] = [
    (
        {TOOL: 100, SLOW: 1}, [], 30, f"{TOOL} has 100 Hz, the slowest state, action or picture of 5 Hz or more; at",
        [f'{SLOW}: 1 Hz, 30 frames for a message: rule = "hold", up to 2,000 ms', f"{TOOL}: 100 Hz, 30 frames for 100"],
    ),
    (
        {TOOL: 100, SLOW: 1}, ["TRANSFORM/**", "Slow"], 1,
        f"{SLOW} has 1 Hz, the slowest named stream; leave it out, or raise fps, for more",
        [f"{TOOL}: 100 Hz, 1 frame for 100 messages"],
    ),
    ({TOOL: 100, SLOW: 1}, ["TRANSFORM/*"], 30, f"{TOOL} has 100 Hz, the slowest named", [f"{TOOL}: 100 Hz"]),
    ({TOOL: 50, FAST: 25, FORCE: 8}, [], 25, f"{FAST} has 25 Hz", [f"{FORCE}: 8 Hz, 3 frames", f"{TOOL}: 50 Hz, 50 f"]),
    ({TOOL: 50, FAST: 25, FORCE: 8}, [TOOL, "Force"], 8, f"{FORCE} has 8 Hz", [f"{TOOL}: 50 Hz, 16 frames"]),
    ({TOOL: 2, SLOW: 1}, [], 2, f"{TOOL} has 2 Hz, the fastest: no state, action or picture has 5 Hz", [SLOW]),
    ({TOOL: 20, JOINTS: 30, "STRING/Note": 0.8}, [], 20, f"{TOOL} has 20 Hz", []),
]  # fmt: skip


@table(("rates", "globs", "fps", "reason", "costs"), DRAFTS)
def test_the_slowest_wanted_stream_gives_the_rate(
    rates: dict[str, float], globs: list[str], fps: int, reason: str, costs: list[str], tmp_path_factory: Any
) -> None:
    folder = tmp_path_factory.mktemp("draft")
    with igtl_gateway.open(session(folder / "s.mcap", rates)) as recording:
        made = draft(recording, globs)
        assert (made.fps, made.reason[: len(reason)]) == (fps, reason)
        found = [each[: len(text)] for each, text in zip(made.costs, costs, strict=False)]
        assert found == costs[: len(found)] and len(made.costs) >= len(costs), made.costs
        assert all(f"# {each}\n" in made.text for each in (made.reason, *made.costs))
        (folder / "r.toml").write_text(made.text, "utf-8")
        recipe = read_recipe(folder / "r.toml")
        # each row states its rule, and the frames are those of the rate
        assert all(row.rule or row.next_of for row in recipe.features)
        seconds = build(recording, recipe).frame_count / fps
    assert seconds > 4 - 2.2 / min(each for name, each in rates.items() if not name.startswith("STRING"))


@pytest.mark.parametrize(("at", "rule", "text"), [(-0.5, "hold", ""), (3.99, "none", "1 of 1 string in no frame")])
def test_a_string_outside_of_the_frames_is_held_or_named(
    at: float, rule: str, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is sent once before all else, such as a model of the robot, is not lost; what comes at the end is named."""
    messages: list[Sent] = [(n / 20, TOOL, arm(n / 20, 0)) for n in range(80)]
    messages = sorted([*messages, (at, "STRING/Model", String(b"<robot/>"))], key=lambda each: each[0])
    path, recipe = write_session(tmp_path / "s.mcap", messages), tmp_path / "r.toml"
    words = ["export", str(path), "--to", "lerobot"]
    assert main([*words, "--write-recipe", str(recipe)]) == 0
    assert {row.rule for row in read_recipe(recipe).features if row.stream == "STRING/Model"} == {rule}
    capsys.readouterr()
    assert main([*words, "--recipe", str(recipe), "-o", str(tmp_path / "set")]) == 0
    said = capsys.readouterr().out
    assert (text in said) if text else "in no frame" not in said


RULES = {
    TOOL: "interpolate",
    JOINTS: "interpolate",
    FAST: "nearest",
    SLOW: "hold",
    FORCE: "hold",
    "STRING/Note": "none",
}


def test_each_kind_of_stream_has_its_rule(tmp_path: Path) -> None:
    rates = {TOOL: 20, JOINTS: 20, FAST: 10, SLOW: 1, FORCE: 20, "STRING/Note": 0.8, "SENSOR/Once": 0.25}
    path = session(tmp_path / "s.mcap", rates)
    with igtl_gateway.open(path) as recording:
        text = draft(recording).text
        (tmp_path / "r.toml").write_text(text, "utf-8")
        assert "#   SENSOR/Once: found 1 message, expected 2 or more" in text
        with pytest.raises(
            ConfigError, match=r"--streams IMAGE/Slwo: matches no recorded stream; did you mean 'IMAGE/"
        ):
            draft(recording, [TOOL, "IMAGE/Slwo"])
    rows = {row.stream: row.rule for row in read_recipe(tmp_path / "r.toml").features if row.stream}
    assert rows == RULES


def test_streams_of_one_last_name_have_rows_of_their_own(tmp_path: Path) -> None:
    """The notes of two arms."""
    one, two = "STRING/PSM1/Note", "STRING/PSM2/Note"
    with igtl_gateway.open(session(tmp_path / "s.mcap", {TOOL: 20, one: 2, two: 2})) as recording:
        (tmp_path / "r.toml").write_text(draft(recording).text, "utf-8")
    names = {row.stream: row.name for row in read_recipe(tmp_path / "r.toml").features if row.stream}
    whole = {"observation.meta.string_psm1_note", "observation.meta.string_psm2_note"}
    assert {names[one], names[two]} - whole == {"observation.meta.note"}


def test_what_the_rate_leaves_out_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """12 s of a tool at 100 Hz beside a picture each second: not nine frames."""
    path = session(tmp_path / "s.mcap", {TOOL: 100, SLOW: 1}, 6.0)
    words = ["export", str(path), "--to", "lerobot"]
    recipe, few = tmp_path / "recipe.toml", tmp_path / "few.toml"
    assert main([*words, "--write-recipe", str(recipe)]) == 0
    said = capsys.readouterr().out
    assert f"fps = 30: {TOOL} has 100 Hz" in said and f"  {SLOW}: 1 Hz, 30 frames for a message" in said
    assert main([*words, "--write-recipe", str(few), "--streams", "**", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["fps"], told["rate_of"]) == (1, SLOW) and told["costs"] == [
        f"{TOOL}: 100 Hz, 1 frame for 100 messages"
    ]
    assert main([*words, "--recipe", str(recipe), "-o", str(tmp_path / "set"), "--json"]) == 0
    done = json.loads(capsys.readouterr().out)
    assert done["frames"] > 140 and done["sparse"] == []
    by_stream = {each["stream"]: each for each in done["streams"]}
    # a picture stands for the second after it, a pose between two that are 10 ms apart
    assert 900 < by_stream[SLOW]["furthest_ms"] < 1000 and 5 < by_stream[TOOL]["furthest_ms"] <= 10
    assert main([*words, "--recipe", str(few), "-o", str(tmp_path / "few")]) == 0
    said = capsys.readouterr().out
    assert (
        f"note: {TOOL} has 100 Hz, the frames 1: " in said
        and "messages are in a frame; a larger fps takes more" in said
    )
    assert "furthest" in said
