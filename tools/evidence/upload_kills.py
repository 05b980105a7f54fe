"""Kills uploads with SIGKILL at random moments, and compares the objects with the files, byte for byte.

    python tools/evidence/upload_kills.py s3://BUCKET/PREFIX [--kills 50] [--seed 1]

The store is that of ``AWS_ENDPOINT_URL``; the bucket has to exist.  It needs boto3 for the comparison: an independent
client, in an environment of its own (``--python``), because it excludes versions of libraries that this project pins.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
from pathlib import Path

from igtl_gateway.addons.upload.place import UploadPlace, upload_place
from tests.record import samples
from tests.record.test_parts import record

_COMPARE = """
import sys, boto3
place, prefix, folder = sys.argv[1:]
found = boto3.client("s3", endpoint_url=__import__("os").environ["AWS_ENDPOINT_URL"])
pages = found.get_paginator("list_objects_v2").paginate(Bucket=place, Prefix=prefix + "/")
keys = [row["Key"] for page in pages for row in page.get("Contents", [])]
for key in keys:
    data = found.get_object(Bucket=place, Key=key)["Body"].read()
    if data != open(folder + "/" + key.removeprefix(prefix + "/"), "rb").read():
        sys.exit(key + " differs")
left = found.list_multipart_uploads(Bucket=place, Prefix=prefix + "/").get("Uploads", [])
print(len(keys), "objects equal their files;", len(left), "uploads are not finished")
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("to", type=upload_place)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--python", default=sys.executable, help="interpreter that has boto3")
    options = parser.parse_args()
    place: UploadPlace = options.to
    chance = random.Random(options.seed)
    killed = number = 0
    while killed < options.kills:
        number += 1
        killed += _round(UploadPlace(place.bucket, f"{place.prefix}/{number}"), chance, options.python)
    print(f"{killed} kills in {number} rounds")
    return 0


def _round(place: UploadPlace, chance: random.Random, python: str) -> int:
    """Upload three recordings, kill the upload until it ends by itself, and compare; return the number of kills."""
    with tempfile.TemporaryDirectory() as name:
        for number in range(3):
            entries = [samples.igtl(seq, body=chance.randbytes(1_000_000)) for seq in range(1, 21)]
            record(Path(name) / f"session{number}.mcap", entries, compression="none")
        words = [sys.executable, "-m", "igtl_gateway", "keep", name, "--upload", str(place), "--upload-rate", "20"]
        killed = 0
        while True:
            with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
                try:
                    process.wait(chance.uniform(0.5, 4.0))
                except subprocess.TimeoutExpired:
                    process.kill()
                    killed += 1
                    continue
            break
        compare = [python, "-c", _COMPARE, place.bucket, place.prefix, name]
        if process.returncode or subprocess.run(compare, check=False).returncode:
            sys.exit(f"round {place.prefix} failed")
        return killed


if __name__ == "__main__":
    sys.exit(main())
