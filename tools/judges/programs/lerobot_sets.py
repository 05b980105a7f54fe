"""LeRobot's own functions on data sets, for ``tools/judges/lerobot.py``: run by a Python that has LeRobot.

    python lerobot_sets.py read SET            a JSON line for each frame that its loader gives
    python lerobot_sets.py write FOLDER OURS   sets that it wrote, merged, split, converted, edited and resumed

``OURS`` is a folder with sets of igtl-gateway, ``v3.0`` and ``v2.1``.  ``write`` prints a JSON line for each set: its
name, and an error if this version cannot make it.
"""

import inspect
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import torch

try:
    from lerobot.datasets import dataset_tools as tools
    from lerobot.datasets.aggregate import aggregate_datasets
except ImportError:  # 0.3.3 has neither
    tools = aggregate_datasets = None
from lerobot.datasets.lerobot_dataset import LeRobotDataset

FPS, ROWS, COLUMNS = 20, 48, 64
NUMBERS = {"dtype": "float32", "shape": (3,), "names": ["x", "y", "z"]}
FEATURES = {"observation.state": NUMBERS, "action": NUMBERS}
PICTURE = {"dtype": "video", "shape": (ROWS, COLUMNS, 3), "names": ["height", "width", "channels"]}
IMAGE = {**PICTURE, "dtype": "image"}
DEPTH = {"shape": (ROWS, COLUMNS, 1), "names": ["height", "width", "channels"], "info": {"is_depth_map": True}}


def opened(root, **options):
    return LeRobotDataset(named(root), root=root, **options)


def named(root):
    """A name as the hub has them."""
    return "judge/" + root.name.replace(",", "").replace(" ", "-")


def recorded(root, features, lengths=(12, 15, 9), first=0, **options):
    """A set of episodes with these lengths, written frame by frame."""
    videos = any(each["dtype"] == "video" for each in features.values())
    set_ = LeRobotDataset.create(
        named(root), FPS, {key: dict(each) for key, each in features.items()}, root=root, use_videos=videos,
        robot_type="arm", **options,
    )  # fmt: skip
    add(set_, features, lengths, first)
    return opened(root)


def add(set_, features, lengths, first=0):
    random = np.random.default_rng(7 + first)
    is_old = "task" in inspect.signature(set_.add_frame).parameters
    for number, length in enumerate(lengths, first):
        for frame in range(length):
            values = {key: value(each, number, frame, random) for key, each in features.items()}
            task = f"task {number % 2}"
            if is_old:
                set_.add_frame(values, task=task)
            else:
                set_.add_frame({**values, "task": task})
        set_.save_episode()
    finish(set_)


def finish(set_):
    getattr(set_, "finalize", lambda: None)()


def value(feature, number, frame, random):
    """A number, or a picture whose content moves."""
    kind, shape = feature["dtype"], tuple(feature["shape"])
    if kind in ("video", "image"):
        ramp = np.add.outer(np.arange(ROWS) * 3, np.arange(COLUMNS) * 2 + 4 * frame + 30 * number)
        if shape[2] == 1:
            return (500 + ramp % 1500).astype(np.uint16)[:, :, None]
        return np.stack([(ramp + 20 * each) % 256 for each in range(3)], axis=2).astype(np.uint8)
    if kind == "string":
        return f"note {frame}"
    if kind == "bool":
        return np.full(shape, frame % 2 == 0)
    return (1 + number + 0.1 * frame + 0.01 * random.normal(size=shape)).astype(kind)


# --- what follows from them  ------------------------------------------------------------------------------------


def more(first, root):
    """A set, resumed."""
    shutil.copytree(first, root)
    if hasattr(LeRobotDataset, "resume"):
        set_ = LeRobotDataset.resume(named(root), root=root)
    else:
        set_ = opened(root)
    own = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    add(
        set_,
        {key: each for key, each in set_.meta.features.items() if key not in own},
        (8, 11),
        set_.meta.total_episodes,
    )


def deleted(first, root, episodes=(1,)):
    tools.delete_episodes(opened(first), list(episodes), output_dir=root, repo_id=named(root))


def split(first, root):
    count = opened(first).meta.total_episodes
    parts = tools.split_dataset(opened(first), {"train": [0], "val": list(range(1, count))}, output_dir=root)
    assert list(parts) == ["train", "val"]


def merged(sources, root):
    tools.merge_datasets([opened(each) for each in sources], named(root), output_dir=root)


def aggregated(sources, root):
    aggregate_datasets([named(each) for each in sources], named(root), roots=sources, aggr_root=root)


def with_feature(first, root):
    set_ = opened(first)
    rewards = np.arange(len(set_), dtype=np.float32) / 7
    feature = {"dtype": "float32", "shape": (1,), "names": None}
    call = getattr(tools, "add_features", None)
    if call:
        call(set_, {"next.reward": (rewards, feature)}, output_dir=root, repo_id=named(root))
    else:
        tools.add_feature(set_, "next.reward", rewards, feature, output_dir=root, repo_id=named(root))


def without_feature(first, root, name):
    tools.remove_feature(opened(first), name, output_dir=root, repo_id=named(root))


def other_tasks(first, root):
    shutil.copytree(first, root)
    tools.modify_tasks(opened(root), new_task="all the same", episode_tasks={0: "another"})


def stats_again(first, root):
    shutil.copytree(first, root)
    tools.recompute_stats(opened(root))


def to_videos(first, root):
    convert = getattr(tools, "convert_image_to_video_dataset", None)
    if convert is None:
        from lerobot.scripts.lerobot_edit_dataset import convert_image_to_video_dataset as convert
    convert(opened(first), output_dir=root, repo_id=named(root))


def to_version_30(first, root):
    try:
        from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset
    except ImportError:
        from lerobot.datasets.v30.convert_dataset_v21_to_v30 import convert_dataset
    shutil.copytree(first, root)
    convert_dataset(named(root), root=str(root), push_to_hub=False)
    shutil.rmtree(root.parent / f"{root.name}_old")


def with_our_files(first, ours, root):
    """A set that was edited, with the files that LeRobot does not know, as a repository on a hub keeps them."""
    shutil.copytree(first, root)
    for path in (ours / "meta").iterdir():
        if path.is_file() and not (root / "meta" / path.name).exists():
            shutil.copy(path, root / "meta" / path.name)


def sets(folder, ours):
    """Yield the name of each set and what makes it, in this order."""

    def at(name):
        return folder / name

    video, three, two = {**FEATURES, "observation.images.top": PICTURE}, ours / "v3.0", ours / "v2.1"
    yield "numbers", lambda root: recorded(root, FEATURES)
    yield "videos", lambda root: recorded(root, video)
    yield "many episodes", lambda root: recorded(root, FEATURES, (3,) * 25)
    yield "videos of 1 frame each", lambda root: recorded(root, video, (1, 1))
    yield "streamed videos", lambda root: recorded(root, video, streaming_encoding=True)
    yield "pictures", lambda root: recorded(root, {**FEATURES, "observation.images.top": IMAGE})
    yield "large pictures", lambda root: recorded(root, {**FEATURES, "observation.images.top": IMAGE}, (3,))
    yield "depth", lambda root: recorded(root, {**video, "observation.images.depth": {**DEPTH, "dtype": "video"}})
    yield (
        "depth pictures",
        lambda root: recorded(root, {**FEATURES, "observation.images.depth": {**DEPTH, "dtype": "image"}}),
    )
    kinds = {
        "observation.text": {"dtype": "string", "shape": (1,), "names": None},
        "observation.flags": {"dtype": "bool", "shape": (2,), "names": None},
        "observation.counts": {"dtype": "int64", "shape": (2,), "names": None},
        "observation.matrix": {"dtype": "float32", "shape": (2, 3), "names": None},
        "observation.one": {"dtype": "float64", "shape": (1,), "names": None},
    }
    yield "all kinds of numbers", lambda root: recorded(root, {**FEATURES, **kinds})
    if tools is None:
        return
    yield "merged", lambda root: merged([at("videos"), at("videos")], root)
    yield "merged numbers", lambda root: merged([at("numbers"), at("numbers")], root)
    yield "merged pictures", lambda root: merged([at("pictures"), at("pictures")], root)
    yield "merged kinds", lambda root: merged([at("all kinds of numbers"), at("all kinds of numbers")], root)
    yield "aggregated", lambda root: aggregated([at("videos"), at("videos")], root)
    yield "deleted", lambda root: deleted(at("videos"), root)
    yield "last deleted", lambda root: deleted(at("videos"), root, (2,))
    yield "split", lambda root: split(at("videos"), root)
    yield "with a feature", lambda root: with_feature(at("videos"), root)
    yield "without a camera", lambda root: without_feature(at("videos"), root, "observation.images.top")
    yield "other tasks", lambda root: other_tasks(at("videos"), root)
    yield "statistics again", lambda root: stats_again(at("videos"), root)
    yield "pictures to videos", lambda root: to_videos(at("pictures"), root)
    yield "resumed", lambda root: more(at("videos"), root)
    yield "deleted, then resumed", lambda root: more(at("deleted"), root)
    yield "export converted", lambda root: to_version_30(two, root)
    yield "export resumed", lambda root: more(three, root)
    yield "export deleted", lambda root: deleted(three, root)
    yield "export split", lambda root: split(three, root)
    yield "export merged", lambda root: merged([three, three], root)
    yield "export with a feature", lambda root: with_feature(three, root)
    yield "export with other tasks", lambda root: other_tasks(three, root)
    yield "export deleted, beside our files", lambda root: with_our_files(at("export deleted"), three, root)
    yield "export merged, beside our files", lambda root: with_our_files(at("export merged"), three, root)


def write(folder, ours):
    for name, make in sets(folder, ours):
        try:
            make(folder / name)
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            print(json.dumps({"set": name, "error": text}), flush=True)
            continue
        print(json.dumps({"set": name}), flush=True)


# --- the loader ---------------------------------------------------------------------------------------------------


def read(root):
    """Numbers as they are; of pictures the mean of each channel in 16 parts."""
    set_ = opened(root)
    print(json.dumps({"episodes": set_.num_episodes, "frames": len(set_)}))
    for number in range(len(set_)):
        item = set_[number]
        print(json.dumps({key: shown(each) for key, each in item.items()}))


def shown(item):
    if not isinstance(item, torch.Tensor):
        return item
    array = item.numpy()
    if array.ndim < 3:
        return array.tolist()
    channels, rows, columns = array.shape
    parts = array[:, : rows // 4 * 4, : columns // 4 * 4].reshape(channels, 4, rows // 4, 4, columns // 4)
    return parts.mean(axis=(2, 4)).tolist()


if __name__ == "__main__":
    if sys.argv[1] == "read":
        read(Path(sys.argv[2]))
    else:
        write(Path(sys.argv[2]), Path(sys.argv[3]))
