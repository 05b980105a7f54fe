"""Stamps to the nanosecond as features, and tables of all messages: both equal to what was sent, and compared."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.export import export_lerobot, export_sessions
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert.common_msgs import JointState
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from tests.addons.lerobot.sessions import BEGIN_NS, Sent, arm, write_session

RATE, FPS = 997.0, 30
RECIPE = """\
[dataset]
fps = 30
task = "press"
format = "{version}"
measure_lags = false
stamps = true
[episodes]
by = "ranges"
range = [{{start = 0.4, end = 1.0}}, {{start = 1.2, end = 1.6}}]
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ToolToBase"
[[feature]]
name = "observation.state"
stream = "/joint_states"
fields = ["position"]
native = true
tolerance_ms = "any"
[[feature]]
name = "observation.force"
stream = "SENSOR/Force"
fields = ["values"]
native = true
lag_ms = {lag_ms}
[[feature]]
name = "observation.meta.note"
stream = "STRING/Note"
rule = "none"
[[feature]]
name = "action"
next_of = "observation.state"
"""


def joint(name: str, value: float) -> Callable[[int], JointState]:
    return lambda stamp_ns: JointState(Header(stamp_ns, ""), (name,), np.array([value]), np.array([]), np.array([]))


def force(number: int) -> list[float]:
    """Three numbers of a message; some of one are missing, and those of another one have no float32."""
    return [float("nan"), 2.0, 3.0] if number == 700 else [number / 7, -1e300 if number == 701 else 0.1, 1 / 3]


def messages(seconds: float = 1.8) -> list[Sent]:
    found: list[Sent] = [(n / 100, "TRANSFORM/ToolToBase", arm(n / 100, 0)) for n in range(round(seconds * 100))]
    found += [(n / RATE, "SENSOR/Force", Sensor(np.array(force(n)))) for n in range(round(seconds * RATE))]
    found += [
        (n / 211 + 1e-9 * n, "/joint_states", joint("yaw" if n % 2 else "pitch", n / 211))
        for n in range(round(seconds * 211))
    ]
    found += [(0.5, "STRING/Note", String(b"contact")), (0.505, "STRING/Note", String(b"slip"))]
    return sorted(found, key=lambda each: each[0])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("native") / "s.mcap", messages())


@pytest.fixture(scope="module")
def sets(recording: Path) -> Path:
    for version in ("v2.1", "v3.0"):
        recipe = recording.parent / f"{version}.toml"
        recipe.write_text(RECIPE.format(version=version, lag_ms=4.0), "utf-8")
        export_lerobot(recording, recipe, recording.parent / version)
    return recording.parent


def sent_ns(stream: str) -> Any:
    return np.array([BEGIN_NS + round(at * 1e9) for at, name, _ in messages() if name == stream])


def test_every_message_has_a_row(sets: Path) -> None:
    root = sets / "v2.1"
    table = parquet.read_table(root / "meta/native/observation.force.0/000000.parquet")
    columns = {name: table[name].to_numpy() for name in table.schema.names}
    assert list(columns)[:6] == ["entry", "time_ns", "stamp_ns", "received_ns", "episode_index", "usable"]
    sent = sent_ns("SENSOR/Force")
    assert table.num_rows == len(sent) > 1700  # none is lost, also outside of the episodes
    values = np.stack([columns[name] for name in list(columns)[6:]], axis=1)
    assert np.array_equal(values, np.array([force(n) for n in range(len(sent))]), equal_nan=True)
    assert np.flatnonzero(~columns["usable"]).tolist() == [700, 701]
    # ticks of OpenIGTLink are 0.23 ns; the lag is subtracted from the time, and not from the stamp
    assert np.abs(columns["stamp_ns"] - sent).max() <= 1
    assert np.array_equal(columns["time_ns"], columns["stamp_ns"] - 4_000_000)
    assert (np.diff(columns["entry"]) > 0).all() and (columns["received_ns"] > columns["stamp_ns"]).all()
    trace = parquet.read_table(root / "meta/provenance.parquet")
    known = dict(zip(columns["entry"].tolist(), columns["stamp_ns"].tolist(), strict=True))
    used = zip(*(trace[f"observation.force[0].{name}"].to_pylist() for name in ("entry", "stamp_ns")), strict=True)
    assert all(known[entry] == stamp for entry, stamp in used)
    for episode in (0, 1):
        frames = trace["time_ns"].to_numpy()[trace["episode_index"].to_numpy() == episode]
        inside = (columns["time_ns"] >= frames[0]) & (columns["time_ns"] <= frames[-1])
        assert np.array_equal(columns["episode_index"] == episode, inside) and inside.sum() > 300
    assert set(columns["episode_index"].tolist()) == {-1, 0, 1}


def test_a_joint_has_no_number_of_another_message(sets: Path) -> None:
    root = sets / "v2.1"
    table = parquet.read_table(root / "meta/native/observation.state.1/000000.parquet").to_pydict()
    assert table["stamp_ns"] == sent_ns("/joint_states").tolist()
    number = np.arange(len(table["entry"]))
    for name, odd in (("yaw.position", 1), ("pitch.position", 0)):
        expected = np.where(number % 2 == odd, number / 211, np.nan)
        assert np.array_equal(np.array(table[name]), expected, equal_nan=True)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_stamps_are_exact_to_the_nanosecond(version: str, sets: Path, recording: Path) -> None:
    root = sets / version
    info = json.loads((root / "meta/info.json").read_text("utf-8"))
    state, labels = "observation.state", info["features"]["stamp_ns"]["names"]
    assert labels == [
        f"{state}[0]",
        f"{state}[0].after",
        f"{state}[1]",
        "observation.force[0]",
        "observation.meta.note[0]",
    ]
    assert {info["features"][name]["dtype"] for name in ("time_ns", "stamp_ns")} == {"int64"}
    rows = pa.concat_tables([parquet.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))])
    assert rows["stamp_ns"].type.value_type == pa.int64()
    stamps, times = np.array(rows["stamp_ns"].to_pylist(), np.int64), rows["time_ns"].to_numpy()
    trace = parquet.read_table(root / "meta/provenance.parquet")
    assert np.array_equal(times, trace["time_ns"].to_numpy())
    joints = sent_ns("/joint_states")
    assert np.array_equal(stamps[:, 2], joints[np.searchsorted(joints, times, "right") - 1])
    tool = sent_ns("TRANSFORM/ToolToBase")
    after = np.searchsorted(tool, times)
    # a frame at the time of a message has this one alone
    assert np.abs(stamps[:, 1] - tool[after]).max() <= 1 and np.abs(stamps[:, 0] - times).max() < 10_000_000
    notes = np.flatnonzero(stamps[:, 4])
    assert rows["observation.meta.note"].to_pylist()[int(notes[0])] == "contact\nslip" and len(notes) == 1
    assert set(rows["observation.meta.note"].to_pylist()) == {"", "contact\nslip"}
    assert check(root, [recording]).findings == []


def test_both_are_compared_with_the_recording(sets: Path, recording: Path, tmp_path: Path) -> None:
    root = tmp_path / "set"
    shutil.copytree(sets / "v2.1", root)
    place = root / "meta/native/observation.force.0/000000.parquet"
    table = parquet.read_table(place)
    for name in ("stamp_ns", "values_1"):
        numbers = table[name].to_numpy().copy()
        numbers[1700] += 1
        table = table.set_column(table.schema.names.index(name), name, pa.array(numbers))
    parquet.write_table(table, place)
    data = root / "data/chunk-000/episode_000001.parquet"
    table = parquet.read_table(data)
    stamps = np.array(table["stamp_ns"].to_pylist())
    stamps[3, 2] += 1
    column = pa.FixedSizeListArray.from_arrays(pa.array(stamps.ravel()), stamps.shape[1])
    parquet.write_table(table.set_column(table.schema.names.index("stamp_ns"), "stamp_ns", column), data)
    (root / "meta/native/observation.state.1/000000.parquet").unlink()
    found = "\n".join(check(root, [recording]).findings)
    for text in (
        "observation.force.0/000000.parquet: stamp_ns: row 1700: found 17",
        "observation.force.0/000000.parquet: values_1: row 1700: found 1.1, expected 0.1",
        "episode 1: stamp_ns: frame 3: found [17",
        "observation.state.1/000000.parquet: No such file",
    ):
        assert text in found, found


@pytest.mark.long
def test_sessions_have_tables_of_their_own_of_the_same_bytes(recording: Path, tmp_path: Path) -> None:
    other = write_session(tmp_path / "t.mcap", [(at + 10, *rest) for at, *rest in messages()])
    recipe = tmp_path / "r.toml"
    recipe.write_text(RECIPE.format(version="v3.0", lag_ms=0.5), "utf-8")
    for paths, out in (([recording, other], "one"), ([other, recording], "two")):
        export_sessions(paths, recipe, tmp_path / out)
    names = [
        f"meta/native/{row}/00000{n}.parquet" for row in ("observation.force.0", "observation.state.1") for n in (0, 1)
    ]
    sums = (tmp_path / "one/meta/SHA256SUMS").read_text("utf-8")
    assert all(name in sums for name in names) and sums == (tmp_path / "two/meta/SHA256SUMS").read_text("utf-8")
    second = parquet.read_table(tmp_path / "one" / names[1])
    assert set(second["episode_index"].to_pylist()) == {-1, 2, 3}
    assert check(tmp_path / "one", [other, recording]).findings == []


def test_only_numbers_have_a_table(recording: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "r.toml"
    text = RECIPE.format(version="v2.1", lag_ms=0).replace('rule = "none"', "native = true")
    recipe.write_text(text, "utf-8")
    with pytest.raises(ConfigError, match=r"feature\[3\].native: found it for a string, expected numbers or poses"):
        export_lerobot(recording, recipe, tmp_path / "set")
