"""Writes a data set by LeRobot's own recorder; `training_writes` runs it in an environment that has LeRobot.

It gets the pictures of a second and the numbers of all frames in a file, and prints the seconds and the seconds of CPU
from the first frame to the end of the set, threads and programs that it starts with it: without its imports.
"""

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

NAMES = ("observation.state", "action")
VIEW = "observation.images.view"


def decoded(packet: Any) -> Any:
    """The RGB picture of a JPEG."""
    codec = import_module("av").CodecContext.create("mjpeg", "r")
    frames = codec.decode(import_module("av").Packet(packet.tobytes()))
    return (frames or codec.decode(None))[0].to_ndarray(format="rgb24")


def cpu_s() -> float:
    """Seconds of CPU of this program and of those that it waited for."""
    return sum(os.times()[:4])


def main(job: Path, out: Path) -> None:
    """Write the set of a job, a file of numpy with ``settings`` in JSON."""
    found = np.load(job)
    settings = json.loads(str(found["settings"]))
    sets = import_module("lerobot.datasets.lerobot_dataset")
    encoder = import_module("lerobot.configs.video").RGBEncoderConfig(**settings["encoder"])
    pictures = [found[f"picture{number}"] for number in range(settings["pictures"])]
    numbers = {name: found[name] for name in NAMES}
    features = {name: {"dtype": "float32", "shape": each.shape[1:], "names": None} for name, each in numbers.items()}
    shape = tuple(settings["shape"])
    features[VIEW] = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"]}
    begun, cpu = time.perf_counter(), cpu_s()
    made = sets.LeRobotDataset.create(
        "a/b", settings["fps"], features, root=out, rgb_encoder=encoder, **settings["recorder"]
    )
    for frame in range(len(numbers["action"])):
        picture = pictures[frame % len(pictures)]
        picture = picture if picture.ndim == 3 else decoded(picture)
        made.add_frame({VIEW: picture, "task": "look"} | {name: each[frame] for name, each in numbers.items()})
    made.save_episode()
    made.finalize()
    print(json.dumps([time.perf_counter() - begun, cpu_s() - cpu]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
