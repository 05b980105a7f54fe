#!/bin/sh
# LeRobot: the splits of a set are read by nothing, and its tools put all episodes into train.
#
# Expected: a set with the splits {"train": "0:2", "val": "2:3"} trains on two episodes, and without episode 0 it has
#   {"train": "0:1", "val": "1:2"}.
# Found: LeRobotDataset has all three episodes, and no argument for a split; lerobot-train takes all but a share of its own.
#   After delete_episodes the splits are {"train": "0:2"}: the held-out episode is one of train.  So with split and merge.
# Versions: lerobot 0.6.1, Python 3.12.
# Concerns: held-out patients become training data, in training or after an edit.  Name the episodes in dataset.episodes.
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
from lerobot.datasets.dataset_tools import delete_episodes

set_ = LeRobotDataset.create("a/b", 10, {"observation.state": NUMBER, "action": NUMBER}, root=Path("set"), use_videos=False)
for _ in range(3):
    for value in range(10):
        number = np.array([value], np.float32)
        set_.add_frame({"observation.state": number, "action": number, "task": "t"})
    set_.save_episode()
set_.finalize()
path = Path("set/meta/info.json")
info = json.loads(path.read_text())
info["splits"] = {"train": "0:2", "val": "2:3"}
path.write_text(json.dumps(info))
opened = LeRobotDataset("a/b", root=Path("set"))
edited = delete_episodes(opened, [0], output_dir=Path("edited"), repo_id="a/c")
after = json.loads(Path("edited/meta/info.json").read_text())["splits"]
print(f"{opened.num_episodes} episodes with {info['splits']}, without episode 0: {after}")
sys.exit(opened.num_episodes != 3 or after != {"train": "0:2"})
PYTHON
"$python" run.py
