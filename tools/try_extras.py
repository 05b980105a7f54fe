"""Install the wheel plainly and with each extra alone, and run the verbs: what is absent is one line with its extra.

    .venv/bin/python tools/try_extras.py [--python python3.10 …] [--extras view,seal] [--wheels dist]

Strategy: a table has calls of every verb, and one for each use of an extra.  In an environment without that extra the
call must end with code 1 and one line that names the extra; with it, no line names an extra; nowhere is a traceback.
Calls without an extra must end with the code of the table.
"""

from __future__ import annotations

import argparse
import gzip
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from igtl_gateway.base.addons import ADDONS
from igtl_gateway.base.extras import PURPOSES
from igtl_gateway.cli.verbs import LABORATORY, VERBS
from tools import core

ROOT = Path(__file__).parents[1]
#: Names in the working folder of the calls → recordings.
RECORDINGS = {
    name: ROOT / "fixtures" / path for name, path in (("small.mcap", "paper-types.mcap"), ("star.mcap", "star.mcap"))
}
LONGEST_S = 600
_PYARROW = ("arrow", "pandas", "lerobot", "cohort")  # all that the calls of these extras need
#: Extra → the extras that have all that its calls need.
_ALSO = {"video": ("lerobot",), "plot": ("lab",), "nifti": ("lab",)} | dict.fromkeys(_PYARROW, _PYARROW)
#: The laboratory is a distribution of its own, which no index needs to have.
_NAMED = re.compile(r"igtl-gateway(?:\[|-)([a-z0-9]+)")


@dataclass(frozen=True)
class Call:
    """Words of a call.

    Attributes:
        extra: the extra that it needs; "": none.
        ends: False if it would run on with the extra.
        code: what a call without an extra ends with: 1 is also a verdict.
        alone: True if it needs what no other extra has.
    """

    words: str
    extra: str = ""
    ends: bool = True
    code: int = 0
    alone: bool = False

    def has_all(self, installed: Set[str]) -> bool:
        """Whether it needs nothing beside these extras."""
        others = () if self.alone else _ALSO.get(self.extra, ())
        return self.extra in ("", *installed) or not installed.isdisjoint(others)


CALLS = (
    *(Call(f"{verb} --help") for verb in (*VERBS, *(verb for verbs in ADDONS.values() for verb in verbs))),
    Call("--version"),
    Call("--help-all"),
    Call("info small.mcap"),
    Call("verify small.mcap"),
    Call("verify --seal small.mcap", code=1),
    Call("diff small.mcap small.mcap"),
    Call("doctor small.mcap"),
    Call("lint small.mcap"),
    Call("decode query.igtl"),
    Call("review star.mcap", code=1),
    Call("sync small.mcap", code=1),
    Call("resim small.mcap -- true", code=2),
    Call("slice small.mcap -o slice.mcap --end 0.5"),
    Call("merge small.mcap star.mcap --offset star=0 -o merged.mcap"),
    Call("recover small.mcap -o recovered.mcap"),
    Call("deidentify small.mcap -o blank.mcap"),
    Call("mark slice.mcap --label here --at 0.1"),
    Call("keep . --retention 30d --dry-run"),
    Call("retain . --retention 30d --dry-run"),
    Call("upload . --upload s3://bucket --patience 0.1", code=1),
    Call("completion bash"),
    Call("bridge --no-ros --duration 0.1 --listen :0 --record bridge.mcap"),
    Call("page recordings", code=2),
    *(Call(f"export small.mcap --to {target} -o {target}") for target in ("csv", "ply", "vtk", "nrrd", "rosbag2")),
    Call("import rosbag2 -o imported.mcap"),
    *(Call(f"export small.mcap --to {target} -o {target}", "arrow") for target in ("parquet", "arrow")),
    Call("export small.mcap --to lerobot --write-recipe recipe.toml", "lerobot"),
    Call("import volume.nii.gz -o volume.mcap", "nifti"),
    Call("import packets.pcapng -o packets.mcap", "pcap"),
    Call("import kinematics.toml -o kinematics.mcap", "hdf5"),
    Call("view small.mcap -o view.rrd", "view"),
    Call("bridge --no-ros --view --duration 0.1 --listen :0", "view", ends=False),
    Call("bridge --duration 0.1 --listen :0", "ros", ends=False),
    Call("replay small.mcap --to ros", "ros", ends=False),
    Call("doctor --listen :0 --ros --seconds 0.1", "ros", ends=False),
    Call("bridge --ros zenoh --duration 0.1 --listen :0", "zenoh", ends=False),
    Call("zenoh-router --listen tcp/127.0.0.1:0", "zenoh", ends=False),
    Call("bridge --no-ros --duration 0.1 --listen ws://:0", "websocket"),
    Call("seal keys new recorder.key", "seal"),
    Call("keys show recorder.key", "seal"),
    Call("seal small.mcap --key recorder.key -o sealed.mcap", "seal"),
    Call("verify --seal small.mcap --trusted recorder.pub", "seal"),
    Call("bridge --no-ros --duration 0.1 --listen :0 --record own.mcap --seal recorder.key", "seal"),
    *(
        Call(f"cohort {what} . -o cohort", "cohort", alone=what == "query")
        for what in ("info", "lint", "verify", "query")
    ),
    Call("sync star.mcap --plot sync.svg", "plot"),
    *(Call(f"{verb} --help", "lab") for verb in LABORATORY),
)


def fault(call: Call, installed: Set[str], code: int, errors: str) -> str:
    """Return what is wrong with the end of a call, or ``""``; ``installed``: the extras of the environment."""
    named = _NAMED.findall(errors)
    if "Traceback" in errors:
        return f"found a traceback ({errors.strip().splitlines()[-1]}), expected one line"
    if call.has_all(installed):
        if named:
            return f"found that {named[0]} is absent, expected nothing absent"
        return "" if call.extra or code == call.code else f"found code {code} ({errors.strip()}), expected {call.code}"
    lines = [line for line in errors.strip().splitlines() if "the new spelling is" not in line]
    right = call.extra in named or (call.extra == "view" and "needs Python" in errors)
    expected = 2 if call.extra == "lab" else 1  # a verb that does not exist, or one that fails
    if code == expected and len(lines) == 1 and right:
        return ""
    found = f"found code {code} and {lines[-1:]} of {len(lines)} lines"
    return f"{found}, expected code {expected} and one line with {call.extra}"


def calls_in(installed: str) -> Iterator[Call]:
    """Yield the calls that are tried beside an extra: plainly all, else each that needs one and ends."""
    for call in CALLS:
        if not installed or (call.extra and (call.ends or call.extra != installed)):
            yield call


def write_inputs(folder: Path) -> None:
    """Write recordings, a message, and other files as far as their readers look before they need a library."""
    for name, path in RECORDINGS.items():
        shutil.copyfile(path, folder / name)
    (folder / "recordings").touch()  # no directory: a page that begins does not end
    (folder / "query.igtl").write_bytes(b"\0\1" + b"GET_STATUS".ljust(12, b"\0") + bytes(44))
    header = (348).to_bytes(4, "little") + bytes(340) + b"n+1\0" + bytes(4)
    (folder / "volume.nii.gz").write_bytes(gzip.compress(header))
    (folder / "arm.h5").touch()
    (folder / "kinematics.toml").write_text(
        '[[table]]\nfile = "arm.h5"\nrate = 30\njoints = [{name = "/arm", position = ["qpos:1"]}]\n', "utf-8"
    )
    (folder / "packets.pcapng").write_bytes(bytes.fromhex("0a0d0d0a1c0000004d3c2b1a01000000ffffffffffffffff1c000000"))


def faults_of(python: str, extra: str, wheels: Path) -> list[str]:
    """Install the wheel with an extra ("": plainly) for a Python, run the calls, return what is wrong."""
    uv = str(Path(sys.executable).with_name("uv"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([uv, "venv", "-q", "--no-python-downloads", "--python", python, folder / "venv"], check=True)
        own = folder / "venv" / "bin"
        wanted = f"igtl-gateway[{extra}]" if extra else "igtl-gateway"
        limits = ("-c", str(ROOT / "constraints.txt"), "--find-links", str(wheels))
        subprocess.run([uv, "pip", "install", "-q", "--python", own / "python", *limits, wanted], check=True)
        # Rerun requires pyarrow, where it has wheels.
        has_arrow = any((folder / "venv").glob("lib/python*/site-packages/pyarrow"))
        installed = {extra} | ({"arrow"} if has_arrow else set())
        write_inputs(folder)
        found = []
        for call in calls_in(extra):
            done = subprocess.run(
                [own / "igtl-gateway", *call.words.split()],
                cwd=folder,
                env=os.environ | {"PYTHONPATH": "", "XDG_CACHE_HOME": str(folder / "cache")},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=LONGEST_S,
                check=False,
            )
            if text := fault(call, installed, done.returncode, done.stderr):
                found.append(f"{python}, {extra or 'plain'}: {call.words}: {text}")
        return found


def build(folder: Path) -> None:
    """Write the pure wheels of the package and of the laboratory."""
    for source in (ROOT, ROOT / "lab"):
        command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(folder), str(source)]
        subprocess.run(command, env=os.environ | {"IGTL_GATEWAY_PURE": "1"}, stdout=subprocess.DEVNULL, check=True)


def main(args: Sequence[str] | None = None) -> int:
    """Try all environments; 1 if a call ends otherwise than it must."""
    parser = argparse.ArgumentParser(description="Install with each extra alone, and run the verbs.")
    parser.add_argument("--python", action="append", metavar="PYTHON", help="(repeatable)")
    parser.add_argument("--extras", default=",".join(("", *PURPOSES)), help="extras to try; an empty name: none")
    parser.add_argument("--wheels", type=Path, metavar="FOLDER", help="wheels to install (default: built here)")
    options = parser.parse_args(args)
    with tempfile.TemporaryDirectory() as folder:
        wheels = options.wheels or Path(folder)
        if options.wheels is None:
            build(wheels)
        found = []
        for python in options.python or [sys.executable]:
            path = core.present(python) or python
            for extra in options.extras.split(","):
                wrong = faults_of(path, extra, wheels)
                print(f"{python}, {extra or 'plain'}: {len(wrong)} wrong", *wrong, sep="\n  ", flush=True)
                found += wrong
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
