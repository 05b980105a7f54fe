"""The sentence for what is missing: one line with the right extra, in every verb that needs a library of one."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from igtl_gateway.base.errors import Unavailable
from igtl_gateway.base.extras import PURPOSES, in_use, missing
from igtl_gateway.base.versions import tomllib
from igtl_gateway.cli.verbs import WITHOUT_LABORATORY
from tests.places import ROOT
from tests.tables import all_hold

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
#: Extra → the module that its row in the documentation names.
MODULES = {
    "ros": "rclpy", "zenoh": "zenoh", "view": "rerun", "video": "av", "nifti": "nibabel", "plot": "matplotlib",
    "pcap": "pcapng", "hdf5": "h5py", "arrow": "pyarrow", "pandas": "pandas", "lerobot": "av", "cohort": "pyarrow",
    "seal": "cryptography", "websocket": "wsproto",
}  # fmt: skip


def test_a_broken_installation_is_told_from_none() -> None:
    assert missing("av") == 'av is not installed here: pip install "igtl-gateway[video]"'
    assert missing("av", ModuleNotFoundError("No module named 'av'", name="av")) == missing("av")
    broken = missing("av", ImportError("libx264.so.164: cannot open shared object file\nmore"))
    assert broken.startswith("av cannot be imported (libx264.so.164: cannot open shared object file): pip install")


def test_who_has_no_ros_learns_that_the_bridge_runs_without_it() -> None:
    assert missing("rclpy").endswith("or source a ROS 2 installation; `bridge --no-ros` needs neither")


def test_what_an_older_python_cannot_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 10, 12))
    assert missing("rerun") == "rerun is not installed here: it needs Python 3.11 or newer"
    assert missing("av") == 'av is not installed here: pip install "igtl-gateway[video]"'


def test_the_extra_is_that_of_the_function() -> None:
    with in_use("lerobot"):
        assert missing("av").endswith('"igtl-gateway[lerobot]"') and missing("pyarrow").endswith('[lerobot]"')
        assert missing("rerun").endswith('"igtl-gateway[view]"')  # which the function's extra does not install
        with in_use():
            assert missing("av").endswith('"igtl-gateway[lerobot]"')
    assert missing("av").endswith('"igtl-gateway[video]"')
    with pytest.raises(Unavailable, match=r"pyarrow is not installed here.*\[cohort\]"), in_use("cohort"):
        raise ModuleNotFoundError("No module named 'pyarrow'", name="pyarrow")
    with pytest.raises(ModuleNotFoundError), in_use("cohort"):  # a defect of our own
        raise ModuleNotFoundError("No module named 'igtl_gateway.x'", name="igtl_gateway.x")


def test_every_extra_has_a_purpose_and_a_message_that_installs_it() -> None:
    assert set(PURPOSES) == set(EXTRAS) - {"dev"} == {*MODULES, "lab"}
    for extra, module in MODULES.items():
        with in_use(extra):
            assert f'pip install "igtl-gateway[{extra}]"' in missing(module)
    assert "pip install --find-links FOLDER igtl-gateway-lab" in WITHOUT_LABORATORY
    assert (ROOT / "lab" / "pyproject.toml").is_file() and "pip install ./lab" in WITHOUT_LABORATORY


STAR = "fixtures/star.mcap"
#: Modules that are missing, command line, extra.
WITHOUT = [
    ("pyarrow", f"export {STAR} --to parquet -o OUT", "arrow"),
    ("pyarrow", f"export {STAR} --to arrow -o OUT", "arrow"),
    ("pyarrow", f"export {STAR} --to lerobot --write-recipe OUT", "lerobot"),
    ("pyarrow", f"export {STAR} --to lerobot --recipe RECIPE -o OUT", "lerobot"),
    ("pyarrow", f"export {STAR} --to lerobot --check OUT", "lerobot"),
    ("av", f"export {STAR} --to lerobot --recipe RECIPE -o OUT", "lerobot"),
    ("pyarrow", f"cohort info {STAR} -o OUT", "cohort"),
    ("duckdb", "cohort query 'SELECT 1' -o OUT", "cohort"),
    ("duckdb", "cohort report -o OUT --html PAGE", "cohort"),
    ("dask", f"cohort info {STAR} -o OUT --scheduler tcp://127.0.0.1:9", "cohort"),
    ("distributed", f"cohort info {STAR} -o OUT --scheduler tcp://127.0.0.1:9", "cohort"),
    ("obstore", "cohort info s3://bucket/prefix -o OUT", "cohort"),
    ("matplotlib", "sync fixtures/ultrasound.mcap --plot PAGE.svg", "plot"),
    ("nibabel", "import VOLUME.nii -o OUT.mcap", "nifti"),
    ("pcapng", "import CAPTURE.pcapng -o OUT.mcap", "pcap"),
    ("h5py", "import KINEMATICS.toml -o OUT.mcap", "hdf5"),
    ("rerun", f"view {STAR} -o OUT.rrd", "view"),
    ("cryptography", "seal keys new OUT.key", "seal"),
    ("cryptography", f"seal {STAR} --key OUT.key -o OUT.mcap", "seal"),
    ("zenoh", "bridge --ros zenoh --listen 127.0.0.1:0 --duration 0.1", "zenoh"),
    ("zenoh", "zenoh-router", "zenoh"),
    ("wsproto", "bridge --no-ros --listen ws://127.0.0.1:0 --duration 0.1", "websocket"),
    ("rclpy", f"replay {STAR} --to ros", "ros"),
    ("rclpy", "bridge --listen 127.0.0.1:0 --duration 0.1", "ros"),
    ("av", "bridge --listen 127.0.0.1:0 --video-codec h264 --duration 0.1", "video"),
]
RECIPE = """\
[dataset]
fps = 10
task = "none"
[[feature]]
name = "observation.state"
stream = "/star/tool"
[[feature]]
name = "observation.images.view"
stream = "/star/camera/image"
tolerance_ms = "any"
[[feature]]
name = "action"
next_of = "observation.state"
"""

KINEMATICS = '[[table]]\nfile = "arm.h5"\nrate = 30\njoints = [{name = "/arm", position = ["qpos:1"]}]\n'


#: Runs each command line in a process that is forked from one with our common modules, and without the library.
PROGRAM = """\
import json, os, sys, traceback
from igtl_gateway.cli import main, bridge
for number, (module, words) in enumerate(json.load(sys.stdin)):
    assert module not in sys.modules, module
    process = os.fork()
    if not process:
        os.dup2(os.open(f"{sys.argv[1]}/{number}", os.O_CREAT | os.O_WRONLY), 2)
        code = 70
        try:
            sys.modules[module] = None
            code = main(words)
            sys.stderr.flush()
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]), flush=True)
"""


@pytest.mark.slow
def test_a_verb_without_its_library_is_one_line(tmp_path: Path) -> None:
    """In processes of their own, where the library cannot be imported, as after a plain installation."""
    (tmp_path / "RECIPE").write_text(RECIPE, "utf-8")
    (tmp_path / "VOLUME.nii").write_bytes((348).to_bytes(4, "little") + bytes(340) + b"n+1\0" + bytes(64))
    (tmp_path / "CAPTURE.pcapng").write_bytes(bytes.fromhex("0a0d0d0a1c0000004d3c2b1a01000000ffffffffffffffff1c000000"))
    (tmp_path / "KINEMATICS.toml").write_text(KINEMATICS, "utf-8")
    (tmp_path / "arm.h5").touch()
    calls = []
    for module, words, _ in WITHOUT:
        named = re.sub(
            r"\b(OUT|RECIPE|PAGE|VOLUME|CAPTURE|KINEMATICS)\b", lambda found: f"{tmp_path}/{found[0]}", words
        )
        calls.append((module, [each.strip("'") for each in re.findall(r"'[^']*'|\S+", named)]))
    told = tmp_path / "told"
    told.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, told], cwd=ROOT, input=json.dumps(calls), capture_output=True, text=True,
        timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    codes = [int(line) for line in done.stdout.splitlines() if line.isdigit()]

    def check(number: int) -> None:
        module, _, extra = WITHOUT[number]
        said = (told / str(number)).read_text("utf-8").strip().splitlines()
        assert codes[number] == 1, said
        assert len(said) == 1, said
        assert f'pip install "igtl-gateway[{extra}]"' in said[0] and module in said[0], said

    all_hold({f"{module}: {words}": number for number, (module, words, _) in enumerate(WITHOUT)}, check)
