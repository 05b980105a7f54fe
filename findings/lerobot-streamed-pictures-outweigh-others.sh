#!/bin/sh
# LeRobot: a set with videos encoded while it was recorded counts pixels, not pictures, and outweighs others in a merge.
#
# Expected: a merge of 10 dark and 10 bright pictures has the mean between them, 0.47.
# Found: the count of the dark set, made with streaming_encoding=True, is 30,720 (10 pictures of 48 x 64), that of the other one
#   10.  The mean of both is 0.079, that of the dark pictures alone.  No warning.
# Versions: lerobot 0.6.1, Python 3.12.
# Concerns: who merges or goes on with sets of both kinds: pictures are normalised with the mean of one of them.
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
from lerobot.datasets.dataset_tools import merge_datasets

VIEW = "observation.images.top"
FEATURES = {
    "observation.state": NUMBER, "action": NUMBER,
    VIEW: {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]},
}


def recorded(name, level, **options):
    set_ = LeRobotDataset.create(f"a/{name}", 10, FEATURES, root=Path(name), **options)
    for _ in range(10):
        picture, number = np.full((48, 64, 3), level, np.uint8), np.zeros(1, np.float32)
        set_.add_frame({"observation.state": number, "action": number, VIEW: picture, "task": "t"})
    set_.save_episode()
    set_.finalize()
    return LeRobotDataset(f"a/{name}", root=Path(name))


if __name__ == "__main__":
    sets = [recorded("dark", 20, streaming_encoding=True), recorded("bright", 220)]
    counts = [int(each.meta.stats[VIEW]["count"][0]) for each in sets]
    mean = float(merge_datasets(sets, "a/both", output_dir=Path("both")).meta.stats[VIEW]["mean"].ravel()[0])
    print(f"counts {counts}, mean of both {mean:.3f}, expected {(20 + 220) / 2 / 255:.3f}")
    sys.exit(counts != [30720, 10] or mean > 0.1)
PYTHON
"$python" run.py
