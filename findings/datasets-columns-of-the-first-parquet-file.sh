#!/bin/sh
# datasets: of several Parquet files the first one alone decides which columns there are, and of which types.
#
# Expected: files of one set with different columns are refused, or the set has all columns.
#           Guess before the run: an error for either, as the error for one column more states that "names don't match".
# Found: a later file with one column more ends the loading; with one less it has None there, and without a warning.
#        The same two files in the other order are loaded. Text in a later file becomes a number if it can ("4" is 4.0).
# Versions: datasets 4.8.5, pyarrow 26.0.1.
# Concerns: who adds files to a set, such as episodes to one of LeRobot, whose metadata are read in this way.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import datasets
import pyarrow as pa
from pyarrow import parquet

datasets.disable_progress_bars()
datasets.logging.set_verbosity(datasets.logging.CRITICAL)
two = pa.table({"x": [1], "y": [1.5]})
one = pa.table({"x": [2]})
three = pa.table({"x": [3], "y": [3.5], "z": [0]})
text = pa.table({"x": [4], "y": ["4"]})
found = []
for number, tables in enumerate([(two, one), (two, three), (three, two), (two, text)]):
    names = [f"{number}-{each}.parquet" for each in range(len(tables))]
    for name, each in zip(names, tables):
        parquet.write_table(each, name)
    try:
        found.append(datasets.Dataset.from_parquet(names, cache_dir=f"cache-{number}").to_dict())
    except datasets.exceptions.DatasetGenerationError as error:
        found.append(type(error.__cause__).__name__)
    print(f"datasets {datasets.__version__}: {[each.schema.names for each in tables]}: {found[-1]}")
expected = [
    {"x": [1, 2], "y": [1.5, None]},
    "CastError",
    {"x": [3, 1], "y": [3.5, 1.5], "z": [0, None]},
    {"x": [1, 4], "y": [1.5, 4.0]},
]
sys.exit(found != expected)
PYTHON
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check datasets==4.8.5 pyarrow==26.0.1
HF_HUB_OFFLINE=1 HF_HOME="$folder/home" venv/bin/python run.py
