#!/bin/sh
# LeRobot: convert_image_to_video_dataset writes episodes without tasks, statistics and places, which its other tools need.
#
# Expected: the set with videos can be edited as the one with pictures; its episodes have their tasks and statistics.
# Found: meta/episodes has neither tasks nor stats nor meta/episodes/chunk_index.  The set loads, but delete_episodes raises
#   KeyError and merge_datasets ValueError, and what reads the tasks of episodes (eval_split) has none.
# Versions: lerobot 0.6.1, Python 3.12.
# Concerns: sets that were recorded as pictures and then made smaller: they can be trained with, and no more edited.
# Runs: the installation loads PyTorch, some GB; LEROBOT_PYTHON names a Python that has LeRobot already.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python=${LEROBOT_PYTHON:-}
if [ -z "$python" ]; then
    python3.12 -m venv "$folder/venv"
    "$folder/venv/bin/pip" install --quiet --disable-pip-version-check "lerobot[dataset]==0.6.1"
    python=$folder/venv/bin/python
fi
cd "$folder"
export HF_HUB_OFFLINE=1
cat > run.py <<'PYTHON'
import json
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

NUMBER = {"dtype": "float32", "shape": (1,), "names": ["x"]}
from lerobot.datasets.dataset_tools import convert_image_to_video_dataset, delete_episodes, merge_datasets

VIEW = "observation.images.top"
FEATURES = {
    "observation.state": NUMBER, "action": NUMBER,
    VIEW: {"dtype": "image", "shape": (48, 64, 3), "names": ["height", "width", "channels"]},
}


def raised(call):
    try:
        call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


if __name__ == "__main__":
    set_ = LeRobotDataset.create("a/b", 10, FEATURES, root=Path("set"), use_videos=False)
    for _ in range(2):
        for value in range(10):
            number, picture = np.array([value], np.float32), np.full((48, 64, 3), value, np.uint8)
            set_.add_frame({"observation.state": number, "action": number, VIEW: picture, "task": "t"})
        set_.save_episode()
    set_.finalize()
    videos = convert_image_to_video_dataset(LeRobotDataset("a/b", root=Path("set")), Path("videos"), "a/c")
    columns = list(videos.meta.episodes.features)
    edits = [
        raised(lambda: delete_episodes(videos, [0], output_dir=Path("edited"), repo_id="a/d")),
        raised(lambda: merge_datasets([videos, videos], "a/e", output_dir=Path("merged"))),
    ]
    print(f"columns {columns}; delete {edits[0]}; merge {edits[1]}")
    sys.exit("tasks" in columns or not all(edits))
PYTHON
"$python" run.py
