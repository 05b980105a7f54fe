"""Depth in videos of 12 bits: read by PyAV, by the rule of LeRobot, it is that of the recording within half a step."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest
from pyarrow import parquet

from igtl_gateway.addons.lerobot.comparing import check
from igtl_gateway.addons.lerobot.depth import CODEC
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.video import VideoFile
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli import main
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.rosmsg import Image as RosImage
from igtl_gateway.wire.image import Image
from tests.addons.lerobot.sessions import Sent, arm, write_session
from tests.tables import table

Array = npt.NDArray[Any]
ROWS, COLUMNS = 33, 49
WINDOWS = {"millimetres": (0.0, 4095.0), "metres": (200.0, 1500.0), "igtl": (0.0, 10_000.0)}
STREAMS = {"millimetres": "/mm/depth", "metres": "/m/depth", "igtl": "IMAGE/Depth"}
RECIPE = """\
[dataset]
fps = 10
task = "look"
format = "v3.0"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ToolToBase"
[[feature]]
name = "action"
next_of = "observation.state"
""" + "".join(
    f'[[feature]]\nname = "observation.images.{name}"\nstream = "{STREAMS[name]}"\ndepth_mm = [{low:g}, {high:g}]\n'
    for name, (low, high) in WINDOWS.items()
)


def plane(name: str, number: int) -> Array:
    """Depth of a picture in its own unit: a slope that moves, with noise, places without a depth and far ones."""
    random = np.random.default_rng([number, len(name)])
    found = np.add.outer(np.arange(ROWS) * 40.0, np.arange(COLUMNS) * 3.0) + 11 * number
    found += random.normal(size=(ROWS, COLUMNS)) * 30
    found = np.clip(found, 0, None)
    found[:3, :3] = 0
    found[-2:, -2:] = 60_000
    if name != "metres":
        return np.round(found).astype(np.uint16)
    found[5, 5] = np.nan
    return (found / 1000).astype(np.float32)


def ros(name: str, encoding: str, number: int) -> Callable[[int], RosImage]:
    pixels = plane(name, number)
    step = COLUMNS * pixels.itemsize
    return lambda stamp_ns: RosImage(Header(stamp_ns, "c"), ROWS, COLUMNS, encoding, 0, step, pixels.tobytes())


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    messages: list[Sent] = [(n / 20, "TRANSFORM/ToolToBase", arm(n / 20, 0)) for n in range(20)]
    for n in range(10):
        messages.append((n / 10 + 0.001, STREAMS["millimetres"], ros("millimetres", "16UC1", n)))
        messages.append((n / 10 + 0.002, STREAMS["metres"], ros("metres", "32FC1", n)))
        pixels = plane("igtl", n).astype("<u2").tobytes()
        messages.append((n / 10 + 0.003, STREAMS["igtl"], Image((COLUMNS, ROWS, 1), 5, pixels)))
    return write_session(tmp_path_factory.mktemp("depth") / "s.mcap", sorted(messages, key=lambda each: each[0]))


@pytest.fixture(scope="module")
def data_set(recording: Path) -> Path:
    recipe, root = recording.parent / "r.toml", recording.parent / "set"
    recipe.write_text(RECIPE, "utf-8")
    export_lerobot(recording, recipe, root)
    return root


def video_of(root: Path, name: str) -> Path:
    return root / f"videos/observation.images.{name}/chunk-000/file-000.mp4"


def codes_in(path: Path) -> list[Array]:
    with av.open(str(path)) as file:
        assert file.streams.video[0].codec_context.pix_fmt == "gray12le"
        return [frame.to_ndarray(format="gray12le") for frame in file.decode(video=0)]


def test_every_pixel_is_that_of_the_recording(data_set: Path, recording: Path) -> None:
    info = json.loads((data_set / "meta/info.json").read_text("utf-8"))
    trace = parquet.read_table(data_set / "meta/provenance.parquet")
    stats = json.loads((data_set / "meta/stats.json").read_text("utf-8"))
    for name, (low, high) in WINDOWS.items():
        feature = info["features"][f"observation.images.{name}"]
        told = feature["info"]
        assert feature["shape"] == [ROWS + 1, COLUMNS + 1, 1] and told["depth_window_mm"] == [low, high]
        assert told["is_depth_map"] is True and (told["depth_unit"], told["video.use_log"]) == ("mm", False)
        stamps = trace[f"observation.images.{name}[0].stamp_ns"].to_numpy()
        numbers = np.round((stamps - 1_700_000_000_000_000_000) / 1e8).astype(int)
        every = []
        for codes, number in zip(codes_in(video_of(data_set, name)), numbers, strict=True):
            # as lerobot 0.6 computes it
            found = (
                codes * ((told["video.depth_max"] - told["video.depth_min"]) / 4095) + told["video.depth_min"]
            ) * 1000
            expected = plane(name, number).astype(np.float64) * (1000 if name == "metres" else 1)
            inside = np.nan_to_num(np.clip(expected, low, high), nan=low)
            assert np.abs(found[:ROWS, :COLUMNS] - inside).max() <= (high - low) / 4095 / 2 + 1e-6, (name, number)
            assert np.array_equal(found[ROWS], found[ROWS - 1]) and np.array_equal(
                found[:, COLUMNS], found[:, COLUMNS - 1]
            )
            every.append(found)
        if name == "millimetres":  # a step is a millimetre
            assert (
                np.abs(np.array(every)[:, :ROWS, :COLUMNS] - np.round(np.array(every)[:, :ROWS, :COLUMNS])).max() < 1e-9
            )
        own = stats[f"observation.images.{name}"]
        assert np.shape(own["mean"]) == (1, 1, 1) and np.isclose(own["mean"][0][0][0], np.mean(every))
        assert np.isclose(own["std"][0][0][0], np.std(every)) and np.isclose(own["max"][0][0][0], high)
    assert check(data_set, [recording]).findings == []


def test_a_changed_pixel_is_found(data_set: Path, recording: Path) -> None:
    path = video_of(data_set, "millimetres")
    kept, every = path.read_bytes(), codes_in(path)
    every[4][20, 30] += 1
    path.unlink()
    video = VideoFile(path, every[0].shape, 10, CODEC)
    for codes in every:
        video.add(codes[:, :, np.newaxis])
    video.close()
    found = "\n".join(check(data_set, [recording]).findings)
    path.write_bytes(kept)
    assert "observation.images.millimetres: frame 4: found " in found and "mm at pixel (30, 20), expected" in found, (
        found
    )


def test_what_has_no_depth_is_said(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "r.toml"
    recipe.write_text(RECIPE, "utf-8")
    words = ["export", str(recording), "--to", "lerobot", "--recipe", str(recipe), "-o", str(tmp_path / "set")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert (
        "note: /m/depth: " in said
        and "of the depth is unknown, or outside of depth_mm, and has one of its ends" in said
    )
    card = (tmp_path / "set/meta/README.md").read_text("utf-8")
    assert "depth from 0 to 4095 mm in steps of 1 mm; unknown depth is 0 mm" in card


#: Changes of the recipe, and the error.
WRONG = [
    (("[0, 4095]", "[4095, 0]"), r"depth_mm: found \[4095, 0\], expected two increasing numbers of mm"),
    (("[0, 4095]", "[-1, 5]"), r"depth_mm: found \[-1, 5\], expected two increasing numbers of mm"),
    (('"v3.0"', '"v2.1"'), r'depth_mm: found it with format = "v2.1", expected "v3.0"'),
    (("depth_mm = [0, 4095]", "depth_mm = [0, 4095]\nwindow = [0, 1]"), "depth_mm: found it with a window"),
    (("observation.images.igtl", "observation.igtl"), "depth_mm: found it with a window, or without a picture"),
]


@table(("change", "text"), WRONG)
def test_what_is_refused(change: tuple[str, str], text: str, tmp_path_factory: Any) -> None:
    recipe = tmp_path_factory.mktemp("wrong") / "r.toml"
    recipe.write_text(RECIPE.replace(*change), "utf-8")
    with pytest.raises(ConfigError, match=text):
        read_recipe(recipe)


def test_colours_are_no_depth(tmp_path: Path) -> None:
    images = [(n / 10, "IMAGE/Depth", Image((20, 20, 1), 3, bytes(1200), num_components=3)) for n in range(10)]
    messages = sorted([*images, *((n / 20, "TRANSFORM/ToolToBase", arm(0, 0)) for n in range(20))], key=lambda e: e[0])
    path = write_session(tmp_path / "s.mcap", messages)
    text = RECIPE.split('[[feature]]\nname = "observation.images')[0]
    text += '[[feature]]\nname = "observation.images.d"\nstream = "IMAGE/Depth"\ndepth_mm = [0, 100]\n'
    (tmp_path / "r.toml").write_text(text, "utf-8")
    with pytest.raises(ConfigError, match="IMAGE/Depth: found 3 components, expected 1 for depth_mm"):
        export_lerobot(path, tmp_path / "r.toml", tmp_path / "set")
