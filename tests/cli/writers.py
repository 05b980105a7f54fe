"""What writes files: a command of each verb, and the files that it reads."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.exchange.targets import TARGETS
from igtl_gateway.cli import main
from igtl_gateway.record.seal.keys import SigningKey
from tests.places import FIXTURES

SMALL = FIXTURES / "paper-types.mcap"

CORPUS = next((Path(__file__).parents[1] / "data" / "corpus").glob("TRANSFORM_v1_s1.bin"))

#: A training set of a short session, with poses and pictures.
RECIPE = """
[dataset]
fps = 5
task = "none"
robot_type = "none"
[episodes]
by = "whole"
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ProbeToTracker"
[[feature]]
name = "action"
stream = "TRANSFORM/ProbeToTracker"
"""

#: What writes files: words of the command line; OUT is a new name in an empty folder, HERE is that folder with a copy
#: of a recording.  ``cohort VERB`` and ``bridge`` write in other processes: ``test_tables_are_private``, and below.
WRITERS = (
    "keys new OUT",
    "slice SMALL -o OUT.mcap --end 1",
    "recover SMALL -o OUT.mcap",
    "recover HERE -o OUT",
    "merge SMALL IMAGES -o OUT.mcap --offset ultrasound=1",
    "deidentify SMALL -o OUT.mcap",
    "import BAG -o OUT.mcap",
    "decode CORPUS -o OUT.igtl",
    *(f"export IMAGES --to {target} -o OUT" for target in TARGETS if target != "seq.nrrd"),
    "export IMAGES --to seq.nrrd -o OUT --streams in:IMAGE/Image_Probe",
    "export IMAGES --to lerobot --write-recipe OUT.toml",
    "export IMAGES --to lerobot --recipe RECIPE -o OUT",
    "seal SMALL --key KEY -o OUT.mcap",
    "sync MOVING --plot OUT.svg --max-lag 0.1",
    "view SMALL -o OUT.rrd",
    "keep HERE --retention 1h",
    "upload HERE --to s3://bucket --patience 0",
    "simulate TINY -o OUT.mcap",
    "cohort query SQL -o COHORT --csv OUT.csv",
    "cohort query SQL -o COHORT --parquet OUT.parquet",
    "cohort report -o COHORT --html OUT.html",
)


def sound_files(folder: Path) -> dict[str, str]:
    """Make what the verbs read in a folder; return the path for each word in capitals of WRITERS."""
    (folder / "key").touch(0o600)
    (folder / "key").write_bytes(SigningKey.generate().private_pem())
    (folder / "recipe.toml").write_text(RECIPE)
    results = Results(folder / "cohort")
    with results.locked():
        results.add({"tasks": [{"task": "a", "file": "a", "verb": "info", "status": "ok"}]}, {})
    assert main(["export", str(SMALL), "--to", "rosbag2", "-o", str(folder / "bag")]) < 2
    fixtures = {"SMALL": SMALL, "IMAGES": FIXTURES / "ultrasound.mcap", "MOVING": FIXTURES / "acquisition.mcap"}
    made = {"KEY": "key", "RECIPE": "recipe.toml", "COHORT": "cohort", "BAG": "bag"}
    paths = {**fixtures, "CORPUS": CORPUS, **{name: folder / path for name, path in made.items()}}
    return {name: str(path) for name, path in paths.items()} | {"SQL": "SELECT * FROM tasks", "TINY": "paper-types"}
