#!/bin/sh
# LeRobot 0.4.4: the standard deviation of pictures in the statistics of a set is 0.
#
# Expected: pictures with all levels from 0 to 255 have the standard deviation 73.9, 0.29 on the scale of the statistics.
# Found: it is 0 in each channel, in meta/stats.json and for each episode: levels are squared as bytes, so 200 * 200 is 64.
#   Mean, minimum and maximum are right.  No warning.  0.6.1 squares numbers.
# Versions: lerobot 0.4.4.
# Concerns: sets that 0.4 recorded, as long as they live: a policy that normalises pictures with them divides by 0, or by a constant
#   beside it.  The default of lerobot-train replaces them by those of ImageNet.
# Runs: the installation loads PyTorch, some GB; LEROBOT_PYTHON names a Python that has LeRobot already.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python=${LEROBOT_PYTHON:-}
if [ -z "$python" ]; then
    python3 -m venv "$folder/venv"
    "$folder/venv/bin/pip" install --quiet --disable-pip-version-check lerobot==0.4.4
    python=$folder/venv/bin/python
fi
cd "$folder"
export HF_HUB_OFFLINE=1
cat > run.py <<'PYTHON'
import sys

import numpy as np
from lerobot.datasets.compute_stats import get_feature_stats

levels = np.arange(256, dtype=np.uint8).repeat(4).reshape(1, 1, 256, 4).repeat(3, axis=1)
found = get_feature_stats(levels, axis=(0, 2, 3), keepdims=True)
print(f"std {found['std'].ravel()}, mean {found['mean'].ravel()}; numpy: {levels.std():.1f}, {levels.mean():.1f}")
sys.exit(found["std"].any() or not np.allclose(found["mean"], levels.mean()))
PYTHON
"$python" run.py
