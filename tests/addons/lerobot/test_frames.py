"""Gaps, odd stamps, invalid values, lags and episodes: what becomes a frame and what does not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.drafting import draft
from igtl_gateway.addons.lerobot.episodes import longest, moving
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.frames import Plan, build
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.log.one_clock import OneClock
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.addons.lerobot.sessions import BEGIN_NS, Sent, arm, bars, pose_m, write_session

ARM = "TRANSFORM/Arm0ToBase"


def recipe_text(state: str = "", more: str = "", dataset: str = "", episodes: str = 'by = "whole"') -> str:
    return f"""\
[dataset]
fps = 20
task = "t"
{dataset}
[episodes]
{episodes}
[[feature]]
name = "observation.state"
stream = "{ARM}"
{state}
{more}
[[feature]]
name = "action"
next_of = "observation.state"
"""


def plan_of(tmp_path: Path, messages: list[Sent], text: str, *, stamped: bool = True) -> Plan:
    with plan_of_open(tmp_path, messages, text, stamped=stamped) as plan:
        return plan


@contextmanager
def plan_of_open(tmp_path: Path, messages: list[Sent], text: str, *, stamped: bool = True) -> Iterator[Plan]:
    """The plan, whose recording is open: pictures are read when they are used."""
    path, recipe = tmp_path / "s.mcap", tmp_path / "r.toml"
    if not path.exists():
        write_session(path, messages, stamped=stamped)
    recipe.write_text(text, "utf-8")
    with igtl_gateway.open(path) as recording:
        yield build(recording, read_recipe(recipe))


def arms(*spans: tuple[float, float], step: float = 0.02) -> list[Sent]:
    return [
        (at, ARM, arm(at, 0))
        for start, end in spans
        for at in (start + number * step for number in range(round((end - start) / step) + 1))
    ]


def test_an_episode_ends_at_a_gap(tmp_path: Path) -> None:
    messages = arms((0, 1), (1.5, 2))
    plan = plan_of(tmp_path, messages, recipe_text())
    assert [each.count for each in plan.episodes] == [20, 10] and plan.cuts == 1
    assert [int(each.times[0]) - BEGIN_NS for each in plan.episodes] == pytest.approx([0, 1.5e9], abs=5)
    for each in plan.episodes:  # no frame is between samples that are further apart
        assert np.allclose(plan.values(each, "observation.state")[:, 0], (each.times - BEGIN_NS) / 1e11, atol=1e-6)
    held = plan_of(tmp_path, messages, recipe_text('fill = "hold"'))
    (episode,) = held.episodes
    assert episode.count == 40
    trace = held.provenance(episode, 0)
    in_gap = (episode.times - BEGIN_NS > 1.0e9 + 100) & (episode.times - BEGIN_NS < 1.5e9 - 100)
    assert np.array_equal(trace["held"], in_gap) and in_gap.sum() == 9
    assert np.allclose(held.values(episode, "observation.state")[in_gap, 0], 0.01, atol=1e-6)
    any_gap = plan_of(tmp_path, messages, recipe_text('tolerance_ms = "any"'))
    assert [each.count for each in any_gap.episodes] == [40]


def test_hold_has_nothing_of_the_future_and_nothing_old(tmp_path: Path) -> None:
    messages = sorted(
        [*arms((0, 2)), *((0.1 * n + 0.013, "SENSOR/Force", Sensor(np.array([n, 2.0 * n]))) for n in range(12))],
        key=lambda each: each[0],
    )
    more = '[[feature]]\nname = "observation.force"\nstream = "SENSOR/Force"\nfields = ["values"]\ntolerance_ms = 250'
    plan = plan_of(tmp_path, messages, recipe_text(more=more))
    (episode,) = plan.episodes
    at = (episode.times - BEGIN_NS) / 1e9
    newest = np.minimum(np.floor((at - 0.013) / 0.1 + 1e-6), 11)
    assert np.array_equal(plan.values(episode, "observation.force")[:, 0], newest)
    assert (
        at[-1] + 0.05 <= 1.113 + 0.25 < at[-1] + 0.1
    )  # the last value is valid for its tolerance, with the next moment
    assert (plan.provenance(episode, 1)["offset_ns"] <= 0).all()


def test_stamps_out_of_order_twice_and_without_value(tmp_path: Path) -> None:
    messages: list[Sent] = arms((0, 1))
    messages[10], messages[11] = messages[11], messages[10]
    messages.insert(20, (messages[20][0], ARM, arm(5.0, 1)))  # the later one of two with one stamp counts
    broken = Transform.from_rows((np.eye(4) * math.nan).tolist())
    messages[30] = (messages[30][0], ARM, broken)
    plan = plan_of(tmp_path, messages, recipe_text())
    samples = plan.samples[0]
    assert samples is not None
    assert (samples.count, samples.unusable, samples.duplicates, samples.disordered) == (52, 1, 1, 1)
    (episode,) = plan.episodes
    assert np.allclose(plan.values(episode, "observation.state")[:, 0], (episode.times - BEGIN_NS) / 1e11, atol=1e-6)


def test_without_stamps_the_clock_is_that_of_the_gateway(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, arms((0, 1)), recipe_text(), stamped=False)
    assert plan.clock == "gateway" and plan.episodes[0].times[0] - BEGIN_NS == 3_000_000
    with pytest.raises(GatewayError, match=r"dataset.clock: found 51 of 51 messages of .* without a stamp"):
        plan_of(tmp_path, [], recipe_text(dataset='clock = "source"'))


@pytest.mark.parametrize(
    ("episodes", "spans"),
    [
        (
            'by = "ranges"\nrange = [{start = 0.5, end = 1.0}, {start = 1, end = 2, task = "b"}]',
            [(0.5, 9), (1.0, 19)],
        ),
        ('by = "gap"\nstream = "STRING/Mark"\npause_s = 0.4', [(0.1, 3), (1.0, 7)]),
        ('by = "markers"\nstream = "STRING/Mark"\nstart = "go"\nstop = "halt"', [(0.1, 3), (1.0, 23)]),
    ],
)
def test_episodes(episodes: str, spans: list[tuple[float, int]], tmp_path: Path) -> None:
    marks = [(0.1, "go one"), (0.3, "halt"), (1.0, "go"), (1.2, "x"), (1.4, "y")]
    messages = sorted(
        [*arms((0, 2.2)), *((at, "STRING/Mark", String(text.encode())) for at, text in marks)], key=lambda each: each[0]
    )
    plan = plan_of(tmp_path, messages, recipe_text(episodes=episodes))
    found = [((int(each.times[0]) - BEGIN_NS) / 1e9, each.count) for each in plan.episodes]
    assert [at for at, _ in found] == pytest.approx([at for at, _ in spans], abs=1e-6)
    assert all(abs(count - expected) <= 1 for (_, count), (_, expected) in zip(found, spans, strict=True)), found
    if "ranges" in episodes:
        assert plan.tasks == ["t", "b"]


def test_a_pause_is_a_time_without_movement() -> None:
    times = np.arange(0, 100) * 100_000_000
    positions = np.zeros((100, 3))
    positions[:, 0] = np.concatenate([np.arange(30), np.full(40, 30), 30 + np.arange(30)]) * 1e-2
    found = moving(times, positions, 1.0, 1e-3)
    assert [(start / 1e9, end / 1e9) for start, end in found] == [(0.0, 3.0), (7.0, 9.9)]


def test_a_measured_lag_is_subtracted_and_an_unknown_one_refused(tmp_path: Path) -> None:
    def placed(number: int) -> Transform:
        at, matrix = number * 0.025, np.eye(4)
        height = math.sin(2.1 * at) + 0.7 * math.sin(3.7 * at + 1) + 0.4 * math.sin(0.21 * at * at)
        matrix[:2, 3] = 20 * height, 3 * height
        return Transform.from_rows(matrix.tolist())

    messages: list[Sent] = []
    for number in range(1000):
        at = number * 0.025
        messages += [(at, ARM, placed(number)), (at + 0.04, "TRANSFORM/LateToBase", placed(number))]
        messages.append((at + 0.001, "TRANSFORM/StillToBase", arm(0.0, 0)))
    messages.sort(key=lambda each: each[0])

    def more(stream: str) -> str:
        return (
            f'[[feature]]\nname = "observation.late"\nstream = "{stream}"\norientation = "none"\nlag = "measured"\n'
            f'against = "{ARM}"'
        )

    plan = plan_of(tmp_path, messages, recipe_text(more=more("TRANSFORM/LateToBase")))
    samples = plan.samples[1]
    assert samples is not None and samples.correction is not None
    assert samples.correction.lag_ns / 1e6 == pytest.approx(40, abs=1)
    (episode,) = plan.episodes
    one, two = plan.values(episode, "observation.state")[:, :3], plan.values(episode, "observation.late")
    assert np.abs(one - two).max() < 1e-3 < np.abs(one[1:] - two[:-1]).max()
    with pytest.raises(GatewayError, match="found no movement"):
        plan_of(tmp_path, [], recipe_text(more=more("TRANSFORM/StillToBase")))


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ('stream = "TRANSFORM/Other"', "feature\\[1\\].stream: .*found no stream"),
        (f'stream = "{ARM}"\nfields = ["x"]', "feature\\[1\\]: fields: found 'x', expected columns of"),
        (f'stream = "{ARM}"\nfields = ["header.stamp_ns"]', "of which float32 keeps steps of minutes, expected"),
        (f'stream = "{ARM}"\nnames = ["a"]', "feature\\[1\\].names: found 1 name, expected 7"),
        ('stream = "STRING/A"\nrule = "interpolate"', "feature\\[1\\].rule: found interpolate for a string"),
        ('stream = "IMAGE/Deep"', "found pictures in IMAGE/Deep"),
    ],
)
def test_what_does_not_fit_the_recording(more: str, text: str, tmp_path: Path) -> None:
    deep = np.arange(64, dtype="<u2").tobytes()
    messages = [*arms((0, 1)), (1.0, "STRING/A", String(b"a")), (1.0, "IMAGE/Deep", Image((8, 8, 1), 5, deep))]
    with pytest.raises(GatewayError, match=text):
        plan_of(tmp_path, messages, recipe_text(more=f'[[feature]]\nname = "observation.more"\n{more}'))


@pytest.mark.parametrize(
    ("images", "more", "text"),
    [
        ([Image((8, 8, 1), 5, bytes(128))] * 9, "", "found pixels of uint16, expected uint8, or window"),
        (
            [Image((64, 48, 1), 3, bars(1).tobytes()), *[Image((8, 8, 1), 3, bytes(64))] * 8],
            "",
            "8 × 8 pixels in message 1",
        ),
        ([Image((8, 8, 2), 3, bytes(128))] * 9, "", "found 2 slices"),
        ([Image((8, 8, 1), 3, bytes(128), num_components=2)] * 9, "", "found 2 components"),
    ],
)
def test_pictures_that_are_refused(images: list[Any], more: str, text: str, tmp_path: Path) -> None:
    messages = sorted(
        [*arms((0, 1)), *((0.1 * n, "IMAGE/View", each) for n, each in enumerate(images))], key=lambda each: each[0]
    )
    row = f'[[feature]]\nname = "observation.images.view"\nstream = "IMAGE/View"\n{more}'
    with pytest.raises(GatewayError, match=text):
        plan_of(tmp_path, messages, recipe_text(more=row))


def test_a_window_makes_eight_bits_of_sixteen(tmp_path: Path) -> None:
    deep = np.linspace(0, 4000, 64).astype("<u2").reshape(8, 8)
    images: list[Sent] = [(0.1 * n, "IMAGE/Deep", Image((8, 8, 1), 5, deep.tobytes())) for n in range(11)]
    row = '[[feature]]\nname = "observation.images.deep"\nstream = "IMAGE/Deep"\nwindow = [1000, 3000]'
    messages = sorted([*arms((0, 1)), *images], key=lambda each: each[0])
    with plan_of_open(tmp_path, messages, recipe_text(more=row)) as plan:
        samples = plan.samples[1]
        assert samples is not None and samples.pictures is not None
        expected = np.round(np.clip((deep - 1000.0) / 2000, 0, 1) * 255)
        assert np.array_equal(samples.pictures.rgb(0)[:, :, 1], expected)


def test_a_stamp_of_another_century_makes_no_frames(tmp_path: Path) -> None:
    messages = [*arms((0, 1)), (3e9, ARM, arm(0, 0))]
    assert [each.count for each in plan_of(tmp_path, messages, recipe_text()).episodes] == [20]
    with pytest.raises(GatewayError, match="found more than 10,000,000 frames"):
        plan_of(tmp_path, [], recipe_text('tolerance_ms = "any"'))


@pytest.mark.parametrize(("fps", "seconds"), [(30, 1024), (20, 2048), (60, 2048), (25, 2048)])
def test_the_longest_episode_is_what_float32_allows(fps: int, seconds: int) -> None:
    count = longest(fps)
    assert count / fps == pytest.approx(seconds, abs=1)
    stamps = (np.arange(count + 10) / fps).astype(np.float32)
    good = np.abs(np.diff(stamps) - np.float32(1 / fps)) <= 1e-4
    assert good[: count - 1].all() and not good[: count + 9].all()


def test_any_name_of_a_stream(tmp_path: Path) -> None:
    """A starting recipe has foreign names with quotes, control characters and other scripts; the card escapes them."""
    names = ["TRANSFORM/Härä|`<b>", 'TRANSFORM/"q\\\x7f\n', "TRANSFORM/\u202e骨"]
    messages = [(number / 50, name, arm(number / 50, 0)) for number in range(50) for name in names]
    path, recipe = write_session(tmp_path / "s.mcap", messages), tmp_path / "r.toml"
    with igtl_gateway.open(path) as recording:
        recipe.write_text(draft(recording).text, "utf-8")
        assert {row.stream for row in read_recipe(recipe).features} >= set(recording.streams) & set(names)
    export_lerobot(path, recipe, tmp_path / "set")
    card = (tmp_path / "set" / "meta" / "README.md").read_text("utf-8")
    assert "\\<b\\>" in card and "\u202e" not in card and "\x7f" not in card


def test_poses_are_those_of_the_api(tmp_path: Path) -> None:
    plan = plan_of(tmp_path, arms((0, 1), step=0.037), recipe_text('orientation = "rotation_6d"'))
    (episode,) = plan.episodes
    for at_ns, state in zip(episode.times, plan.values(episode, "observation.state"), strict=True):
        expected = pose_m((int(at_ns) - BEGIN_NS) / 1e9, 0)
        assert np.allclose(state, [*expected[:3, 3], *expected[:3, 0], *expected[:3, 1]], atol=1e-6)


def test_poses_beyond_float32_are_unusable(tmp_path: Path) -> None:
    """1e308 m is finite in a message, and infinite in a data set."""
    near = (0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0)
    far = (1e308, -1e308, 0.5, 0.0, 0.0, 0.0, 1.0)
    messages: list[Sent] = [
        (0.02 * n, "/arm/measured_cp", partial(_pose_message, far if n == 7 else near)) for n in range(30)
    ]
    path = write_session(tmp_path / "s.mcap", messages)
    with igtl_gateway.open(path) as recording:
        text = draft(recording).text
        (tmp_path / "r.toml").write_text(text, "utf-8")
        samples = build(recording, read_recipe(tmp_path / "r.toml")).samples[0]
    assert samples is not None and (samples.count, samples.unusable) == (30, 1)
    only = write_session(tmp_path / "far.mcap", [(at, name, partial(_pose_message, far)) for at, name, _ in messages])
    with igtl_gateway.open(only) as recording, pytest.raises(GatewayError, match="found no stream of poses or joints"):
        draft(recording)


def _pose_message(pose: tuple[float, ...], stamp_ns: int) -> PoseStamped:
    return PoseStamped(Header(stamp_ns, "base"), pose)  # type: ignore[arg-type]


def test_a_stream_of_thousands_of_numbers_is_left_out(tmp_path: Path) -> None:
    names, nothing = tuple(f"j{number}" for number in range(5_000)), np.array([])
    messages: list[Sent] = arms((0, 1))
    messages += [
        (0.3 * n + 0.001, "/joint_states",
         lambda stamp_ns: JointState(Header(stamp_ns, ""), names, np.zeros(5_000), nothing, nothing))
        for n in range(3)
    ]  # fmt: skip
    path = write_session(tmp_path / "s.mcap", sorted(messages, key=lambda each: each[0]))
    with igtl_gateway.open(path) as recording:
        text = draft(recording).text
    assert "found 5,000 numbers in position, expected at most 4,096" in text and f'stream = "{ARM}"' in text


def _states(*names: str, sign: float = 1.0) -> Callable[[int], JointState]:
    """A state in which the position of a joint is the number at the end of its name."""
    values = np.array([sign * int(name[-1]) for name in names])
    return lambda stamp_ns: JointState(Header(stamp_ns, ""), names, values, np.array([]), np.array([]))


@pytest.mark.parametrize("rule", ["hold", "nearest", "interpolate"])
def test_joints_go_by_name_whoever_publishes_them_in_any_order(rule: str, tmp_path: Path) -> None:
    random, messages = np.random.default_rng(1), list[Sent]()
    for number in range(200):
        side, sign = ("left", 1.0) if number % 2 else ("right", -1.0)
        names = [f"{side}_{joint}" for joint in random.permutation(3) + 1]
        messages.append((number / 100, "/joint_states", _states(*names[: 2 if number % 7 == 3 else 3], sign=sign)))
    path = write_session(tmp_path / "s.mcap", messages)
    recipe = f"""[dataset]
fps = 30
task = "t"
[[feature]]
name = "observation.state"
stream = "/joint_states"
fields = ["position"]
rule = "{rule}"
[[feature]]
name = "action"
next_of = "observation.state"
"""
    (tmp_path / "r.toml").write_text(recipe)
    with igtl_gateway.open(path) as recording:
        plan = build(recording, read_recipe(tmp_path / "r.toml"))
        values = np.concatenate([plan.values(episode, "observation.state") for episode in plan.episodes])
    names = plan.names("observation.state")
    assert sorted(names) == [f"{side}_{joint}.position" for side in ("left", "right") for joint in (1, 2, 3)]
    expected = [(1 if name.startswith("left") else -1) * int(name.split(".")[0][-1]) for name in names]
    assert len(values) > 50
    np.testing.assert_array_equal(values, np.broadcast_to(np.array(expected, np.float32), values.shape))


def test_a_joint_that_is_no_longer_published_has_no_value(tmp_path: Path) -> None:
    messages: list[Sent] = [
        (number / 100, "/joint_states", _states("a1", "b2") if number < 100 else _states("a1")) for number in range(200)
    ]
    path = write_session(tmp_path / "s.mcap", messages)
    with igtl_gateway.open(path) as recording:
        text = draft(recording).text
        for rule, most in (("interpolate", 100), ("hold", 111)):  # hold: 100 ms longer at most
            (tmp_path / "r.toml").write_text(text.replace('rule = "interpolate"', f'rule = "{rule}"'), "utf-8")
            samples = build(recording, read_recipe(tmp_path / "r.toml")).samples[0]
            assert samples is not None and samples.names == ("a1.position", "b2.position")
            assert most - 1 <= len(samples.times) <= most and samples.unusable == 200 - len(samples.times), rule


@pytest.mark.parametrize("ahead_s", [3.0, -3.0])
def test_streams_of_two_clocks_are_on_one(tmp_path: Path, ahead_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """One arm, and the markers, are on a computer whose clock is wrong by 3 s; the other arm is not."""
    other, told = "TRANSFORM/Arm1ToBase", "STRING/Marker"
    messages = sorted(
        [
            *((0.02 * n, ARM, arm(0.02 * n, 0)) for n in range(300)),
            *((0.02 * n + 0.001, other, arm(0.02 * n + 0.001, 0)) for n in range(300)),
            *((at, told, String(text)) for at, text in ((2.0, b"start: sew"), (3.0, b"stop"))),
        ],
        key=lambda each: each[0],
    )
    path, recipe, out = tmp_path / "s.mcap", tmp_path / "r.toml", tmp_path / "set"
    write_session(path, messages, ahead_s={other: ahead_s, told: ahead_s})
    more = f'[[feature]]\nname = "observation.other"\nstream = "{other}"'
    recipe.write_text(recipe_text(more=more, episodes=f'by = "markers"\nstream = "{told}"'), "utf-8")
    export_lerobot(path, recipe, out)
    with igtl_gateway.open(path) as recording:
        plan = build(recording, read_recipe(recipe))
    (episode,) = plan.episodes
    # both move alike, 10 mm/s; the latency of 3 ms remains
    one, two = (plan.values(episode, name)[:, 0] for name in ("observation.state", "observation.other"))
    assert np.abs(one - two).max() < 0.00005
    assert np.allclose(one[[0, -1]], [0.02, 0.0295], atol=0.0006)  # the markers cut the movement that they mean
    (note,) = plan.joined.notes
    assert f"the stamps of {other}, {told} are" in note and "corrected by" in note
    assert note in (out / "meta" / "README.md").read_text("utf-8").replace("\\", "")
    assert check(out, [path]).findings == []
    if ahead_s < 0:  # there, earlier versions found no common time
        return
    # a set that was made of stamps of two clocks, as earlier versions made it, is found
    with monkeypatch.context() as patched:
        alike = "igtl_gateway.addons.lerobot.samples.one_clock"
        patched.setattr(alike, lambda streams, wanted="auto": OneClock("source", (0,) * len(streams)))
        export_lerobot(path, recipe, tmp_path / "wrong")
    assert check(tmp_path / "wrong", [path]).findings
