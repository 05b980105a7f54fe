#!/bin/sh
# LeRobot: the quantiles of a set are means of those of its episodes; between q01 and q99 may be no value at all.
#
# Expected: 100 values from 0 to 1 in one episode and 100 from 10 to 11 in another: q01 = 0.02 and q99 = 10.98, as numpy has.
# Found: meta/stats.json has q01 = 5.0 and q99 = 5.99, an interval in which no value of the set is.  Minimum, maximum, mean and
#   standard deviation are right.  No warning; a merge does the same with the quantiles of its sets.
# Versions: lerobot 0.6.1, Python 3.12.
# Concerns: policies that normalise with quantiles, such as pi0.5: episodes that differ (patients, tools, phases) become numbers
#   far outside of -1 to 1.
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

set_ = LeRobotDataset.create("a/b", 10, {"observation.state": NUMBER, "action": NUMBER}, root=Path("set"), use_videos=False)
values = np.concatenate([np.linspace(0, 1, 100), np.linspace(10, 11, 100)]).astype(np.float32)
for number, value in enumerate(values):
    set_.add_frame({"observation.state": np.array([value]), "action": np.array([value]), "task": "t"})
    if number in (99, 199):
        set_.save_episode()
set_.finalize()
stats = json.loads(Path("set/meta/stats.json").read_text())["action"]
low, high = stats["q01"][0], stats["q99"][0]
inside = int(((values >= low) & (values <= high)).sum())
print(f"q01 {low:.4g}, q99 {high:.4g}, {inside} of {len(values)} values between; numpy:", np.quantile(values, [0.01, 0.99]))
sys.exit(inside > 0 or (stats["min"][0], stats["max"][0]) != (0.0, 11.0))
PYTHON
"$python" run.py
