#!/bin/sh
# LeRobot: the task of a frame is that in row task_index of tasks.parquet, not the one with that task_index.
#
# Expected: task_index 0 of tasks.parquet is "a": a frame with task_index 0 has the task "a", in whatever order the rows are.
# Found: with the rows in reverse order the frame has the task "b".  No error, and no warning.
# Versions: lerobot 0.6.1, Python 3.12.
# Concerns: who sorts or joins the tables of a set: policies that read the task learn the wrong one.
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
import pandas

set_ = LeRobotDataset.create("a/b", 10, {"observation.state": NUMBER, "action": NUMBER}, root=Path("set"), use_videos=False)
for task in ("a", "b"):
    for value in range(10):
        number = np.array([value], np.float32)
        set_.add_frame({"observation.state": number, "action": number, "task": task})
    set_.save_episode()
set_.finalize()
before = LeRobotDataset("a/b", root=Path("set"))[0]
path = Path("set/meta/tasks.parquet")
pandas.read_parquet(path).iloc[::-1].to_parquet(path)
after = LeRobotDataset("a/b", root=Path("set"))[0]
print(pandas.read_parquet(path))
print(f"task_index {int(after['task_index'])}: {after['task']}, before {before['task']}")
sys.exit((before["task"], after["task"], int(after["task_index"])) != ("a", "b", 0))
PYTHON
"$python" run.py
