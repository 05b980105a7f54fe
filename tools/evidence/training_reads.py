"""Samples in random order from recordings and from the exported set of the same content, in turns.

    .venv/bin/python -m tools.evidence.training_reads [--seconds 20] [--rounds 3] [--samples 300]

A session for each form of its pictures (640 × 480, 30 Hz) with a pose at 100 Hz, written as the recorder does.  The
exported set (v3.0, 30 frames a second) is read by a plain program: its table is in memory, its video stays open, and
PyAV seeks the key frame before each frame, as LeRobot does; the set has one at every second frame.  Both give RGB of 8
bits.  With ``--lerobot``, in an environment with LeRobot, its loader and ``to_torch`` are compared instead: both give
tensors of float32.  A round reads the same frames from both; the table has medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from pyarrow import parquet

from igtl_gateway.addons.lerobot import dataset
from igtl_gateway.addons.lerobot.export import export_sessions
from igtl_gateway.base.buffers import join
from igtl_gateway.base.stamp import ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from igtl_gateway.wire.video import Video

Pixels = npt.NDArray[np.uint8]
POSES_HZ, FPS, SIZE = 100, 30, (480, 640)
VIEW, TOPIC = "observation.images.view", "/camera/compressed"
#: Form → stream of its pictures.
STREAMS = {
    "JPEG": TOPIC,
    "IMAGE, RGB": "IMAGE/Camera",
    "VIDEO, H.264, a key frame in 2": "VIDEO/Camera",
    "VIDEO, H.264, a key frame in 30": "VIDEO/Camera",
}
RECIPE = """\
[dataset]
fps = 30
task = "look"
format = "v3.0"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/Tool"
[[feature]]
name = "observation.images.view"
stream = "{stream}"
[[feature]]
name = "action"
next_of = "observation.state"
"""


def pictures() -> list[Pixels]:
    """A second of a moving pattern with the noise of a sensor."""
    chance = np.random.default_rng(1)
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    waves = ([120 + 60 * np.sin((x + 3 * at) / 50 + c) + 40 * np.cos(y / 37) for c in range(3)] for at in range(FPS))
    noisy = (np.stack(each, -1) + chance.normal(0, 2, (*SIZE, 3)) for each in waves)
    return [np.clip(each, 0, 255).astype(np.uint8) for each in noisy]


def encoded(codec: str, every: Sequence[Pixels], gop: int) -> list[bytes]:
    """The pictures one after the other, each a packet."""
    encoder: Any = av.CodecContext.create(codec, "w")
    encoder.height, encoder.width = SIZE
    encoder.time_base, encoder.gop_size = Fraction(1, FPS), gop
    encoder.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    if codec == "libx264":
        params = f"keyint={gop}:min-keyint={gop}:scenecut=0:repeat-headers=1"
        encoder.options = {"tune": "zerolatency", "preset": "veryfast", "x264-params": params}
    else:
        encoder.options = {"qmin": "2", "qmax": "4"}
    packets = []
    for number, each in enumerate(every):
        frame = av.VideoFrame.from_ndarray(each, format="rgb24").reformat(format=encoder.pix_fmt)
        frame.pts = number
        packets += [bytes(packet) for packet in encoder.encode(frame)]
    return packets + [bytes(packet) for packet in encoder.encode(None)]


def bodies(form: str) -> Sequence[Body | bytes]:
    """A second of pictures in a form: of OpenIGTLink, or JPEG data."""
    every = pictures()
    if form == "JPEG":
        return encoded("mjpeg", every, 1)
    if form.startswith("IMAGE"):
        return [Image((SIZE[1], SIZE[0], 1), 3, each.tobytes(), 3) for each in every]
    gop = int(form.rpartition(" ")[2])
    return [Video("H264", (SIZE[1], SIZE[0], 1), each) for each in encoded("libx264", every, gop)]


def write(path: Path, form: str, seconds: int) -> None:
    """Write a session as the recorder does."""
    gateway, every = ManualGateway(Config()), bodies(form)
    link, number = gateway.connect(), 0
    for step in range(seconds * POSES_HZ):
        gateway.advance(1 / POSES_HZ)
        ticks = ns_to_ticks(gateway.now_ns)
        if step * FPS >= number * POSES_HZ:
            body = every[number % len(every)]
            number += 1
            if isinstance(body, bytes):
                image = CompressedImage(Header(gateway.now_ns, "camera"), "jpeg", body)
                gateway.from_ros(TOPIC, image, source_ns=gateway.now_ns)
            else:
                kind, _, device = STREAMS[form].partition("/")
                gateway.from_peer(join(encode(Message(kind, device, body, ticks=ticks))), link)
        pose = Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, float(step), 0, 0))
        gateway.from_peer(join(encode(Message("TRANSFORM", "Tool", pose, ticks=ticks))), link)
    writer = SessionWriter(path, {"config": json.dumps(Config().to_dict())}, compression="lz4", together=True)
    for entry in gateway.log:
        writer.write(entry)
    writer.close({})


class PlainSet:
    """The exported set by pyarrow and PyAV alone."""

    def __init__(self, root: Path) -> None:
        files = sorted((root / "data").rglob("*.parquet"))
        table = parquet.read_table(files[0])
        self.state = np.stack(table["observation.state"].to_numpy(zero_copy_only=False))
        self.times = table["timestamp"].to_numpy()
        self.video = av.open(str(next((root / "videos").rglob("*.mp4"))))
        self.stream = self.video.streams.video[0]

    def read(self, frame: int) -> tuple[Any, Pixels]:
        """Return state and picture of a frame."""
        base = self.stream.time_base
        wanted = round(float(self.times[frame]) / base)
        self.video.seek(wanted, stream=self.stream, backward=True, any_frame=False)
        for each in self.video.decode(self.stream):
            if each.pts >= wanted:
                return self.state[frame], each.to_ndarray(format="rgb24")
        raise LookupError(frame)


def timed(read: Callable[[int], Any], frames: Sequence[int]) -> tuple[float, float]:
    """Seconds and seconds of CPU for a sample."""
    begun, cpu = time.perf_counter(), time.process_time()
    for each in frames:
        read(each)
    return (time.perf_counter() - begun) / len(frames), (time.process_time() - cpu) / len(frames)


def lerobot_reader(root: Path) -> Callable[[int], Any]:
    """Return what reads a sample by LeRobot's own loader, with PyAV."""
    import_module("torch").set_num_threads(1)  # as in the workers of its DataLoader
    found = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset("a/b", root=root, video_backend="pyav")
    read: Callable[[int], Any] = found.__getitem__
    return read


def measure(folder: Path, form: str, options: argparse.Namespace) -> str:
    """Return the row of a form."""
    path, recipe = folder / "s.mcap", folder / "recipe.toml"
    write(path, form, options.seconds)
    recipe.write_text(RECIPE.format(stream=STREAMS[form]), "utf-8")
    export_cpu = time.process_time()
    export_sessions([path], recipe, folder / "set")
    export_cpu = time.process_time() - export_cpu
    open_cpu = time.process_time()
    samples = dataset(path, recipe)
    open_cpu = time.process_time() - open_cpu
    plain, chance = PlainSet(folder / "set"), np.random.default_rng(1)
    read = lerobot_reader(folder / "set") if options.lerobot else plain.read
    own_read = samples.to_torch().__getitem__ if options.lerobot else samples.__getitem__
    ours, theirs = [], []
    for _ in range(options.rounds):
        frames = chance.integers(0, len(samples), options.samples).tolist()
        ours.append(timed(own_read, frames))
        theirs.append(timed(read, frames))
    for frame in chance.integers(0, len(samples), 5).tolist():
        state, picture = plain.read(frame)
        assert np.array_equal(state, samples[frame]["observation.state"])
        assert np.abs(picture.astype(int) - samples[frame][VIEW]).mean() < 8
    size = sum(each.stat().st_size for each in (folder / "set").rglob("*") if each.is_file())
    ratios = [median(two[at] / one[at] for one, two in zip(ours, theirs, strict=True)) for at in (0, 1)]
    own, other = (median(cpu for _, cpu in each) * 1e3 for each in (ours, theirs))
    return (
        f"| {form} | {own:.2f} | {other:.2f} | {ratios[1]:.2f} | {ratios[0]:.2f} | {open_cpu:.1f} | {export_cpu:.1f} "
        f"| {path.stat().st_size / 1e6:.0f} | {size / 1e6:.0f} |"
    )


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=20, help="of each session")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=300, help="of each round")
    parser.add_argument("--lerobot", action="store_true", help="beside LeRobot's own loader")
    parser.add_argument("--forms", nargs="+", choices=STREAMS, default=list(STREAMS))
    options = parser.parse_args()
    print("| pictures | recording, ms of CPU | set, ms of CPU | set / recording, CPU | the same, time "
          "| opened, s of CPU | exported, s of CPU | recording, MB | set, MB |")  # fmt: skip
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for form in options.forms:
        with tempfile.TemporaryDirectory() as folder:
            print(measure(Path(folder), form, options), flush=True)


if __name__ == "__main__":
    main()
