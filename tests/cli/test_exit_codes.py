"""Exit codes: 0 good, 1 a finding or a failure, 2 usage; the same cause has the same code in every verb."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from igtl_gateway.base.extras import missing
from tests.places import ROOT

FIXTURE = ROOT / "fixtures" / "paper-types.mcap"


@dataclass(frozen=True)
class Case:
    """A call and how it ends; in its words ``{port}`` is a port that is taken, ``{folder}`` a folder of its own."""

    call: str
    code: int
    said: str
    without: tuple[str, ...] = ()  # modules that cannot be imported


ROS, RERUN, AV = ("rclpy",), ("rerun", "rerun_cli"), ("av",)
BRIDGE = "bridge --no-ros --duration 0.1 --listen :0"
DOCUMENT = (ROOT / "docs" / "reference" / "command-line.md").read_text()

#: A package is missing: 1, with one sentence that names the way to install it.
MISSING = [
    Case("bridge --duration 0.1 --listen :0", 1, missing("rclpy"), ROS),
    Case("replay {fixture} --to ros", 1, missing("rclpy"), ROS),
    Case("replay {fixture} --to both --listen :0", 1, missing("rclpy"), ROS),
    Case("simulate star", 1, missing("rclpy"), ROS),
    Case("bench --case transform", 1, missing("rclpy"), ROS),
    Case("demo", 1, missing("rclpy"), ROS),
    Case("doctor --listen :0 --ros --seconds 0.1", 1, missing("rclpy"), ROS),
    Case("view {fixture}", 1, missing("rerun"), RERUN),
    Case("view {fixture} -o {folder}/out.rrd", 1, missing("rerun"), RERUN),
    Case(f"{BRIDGE} --view", 1, missing("rerun"), RERUN),
    Case("bridge --duration 0.1 --listen :0 --video-codec h264", 1, missing("av"), AV),
]

#: Refused by the system: 1.
REFUSED = [
    Case("bridge --no-ros --duration 0.1 --listen 127.0.0.1:{port}", 1, "the port is in use by another program"),
    Case(f"{BRIDGE} --metrics {{port}}", 1, "the port is in use by another program"),
    Case(f"{BRIDGE} --cpu-affinity 8000", 1, "--cpu-affinity: found CPU 8000, expected CPUs of "),
    Case("replay {fixture} --to igtl --listen 127.0.0.1:{port}", 1, "the port is in use by another program"),
    *(
        Case(f"{call} {place}", 1, said)
        for call in (f"{BRIDGE} --record", "simulate paper-types -o", "recover {fixture} --output")
        for place, said in (
            ("{folder}/none/out.mcap", "there is no folder {folder}/none"),
            ("{folder}", "it is a folder, expected a file or a new name"),
            ("{folder}/fifo", "it is a FIFO, expected a file or a new name"),
            ("{folder}/file/out.mcap", "{folder}/file is a file, expected a folder"),
            ("{folder}/{long}", "File name too long: 300 bytes"),
            ("/dev/full", "it is a device, expected a file or a new name"),
            ("/proc/out.mcap", "no file can be created in /proc"),
        )
    ),
    Case(f"{BRIDGE} --split-size 1 --record /proc/out.mcap", 1, "no file can be created in /proc"),
    Case(f"{BRIDGE} --snapshot 5 --record /proc/out.mcap", 1, "no file can be created in /proc"),
    Case(f"{BRIDGE} --snapshot 5 --record {{folder}}/{{long}}", 1, "File name too long"),
]

#: Errors that a retry does not repair: 2.
USAGE = [
    *(  # a link is replaced itself, and only if that is asked for
        Case(f"{call} {{folder}}/link", 2, "exists already, expected a new file or --overwrite")
        for call in ("simulate paper-types -o", "recover {fixture} --output")
    ),
    Case("bridge --listen 127.0.0.1:99999", 2, "found '127.0.0.1:99999', expected HOST:PORT"),
    Case(f"{BRIDGE} --realtime-priority 100", 2, "found 100, expected 0 to 99"),
    Case(f"{BRIDGE} --cpu-affinity two", 2, "found 'two', expected CPUs such as 2,4-6"),
    Case("bridge --listen 0.0.0.0:0 --no-ros", 2, "none may connect"),
    Case("bridge --listen no.such.host.invalid:0 --no-ros", 2, "expected an address of this machine"),
    Case("bridge --listen 203.0.113.77:0 --allow any --no-ros", 2, "expected an address of this machine"),
    Case("bridge --config {folder}/none.toml", 2, "cannot be read"),
    Case("bridge --config {folder}/file", 2, "is not valid TOML"),
    Case("bridge --fly", 2, "--fly"),
    Case("simulate acquisition --duration -1", 2, "--duration: found -1.0"),
    *(
        Case(f"{verb} {file}", 2, said)
        for verb in ("info", "verify", "doctor", "review", "replay --to igtl", "recover")
        for file, said in (("{folder}/none.mcap", "No such file"), ("{folder}/text", "{folder}/text"))
    ),
    Case("decode {folder}/none.igtl", 2, "No such file"),
]

#: Findings in the input: 1.
FINDINGS = [
    Case("verify {folder}/cut.mcap", 1, "{folder}/cut.mcap"),
    Case("info {folder}/cut.mcap", 1, "{folder}/cut.mcap"),
    Case("decode {folder}/cut.igtl", 1, "the stream ends inside it"),
]

GOOD = [
    Case("info {fixture}", 0, ""),
    Case("verify {fixture}", 0, ""),
    Case("decode {folder}/whole.igtl", 0, ""),
    Case(f"{BRIDGE} --record {{folder}}/new.mcap", 0, ""),
]

CALLS = """
import contextlib, io, json, sys
from igtl_gateway.cli import main
for words, modules in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    hidden = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(dict.fromkeys(modules))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:
            code = end.code
    for name, module in hidden.items():
        sys.modules.pop(name)
        if module:
            sys.modules[name] = module
    print(json.dumps([code, out.getvalue(), err.getvalue()]), flush=True)
"""


@pytest.mark.parametrize("group", ["MISSING", "REFUSED", "USAGE", "FINDINGS", "GOOD"])
def test_the_same_cause_has_the_same_code(group: str, tmp_path: Path) -> None:
    cases: list[Case] = globals()[group]
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").write_text("not a recording\n")
    (tmp_path / "text").write_text("not a recording, but longer\n" * 100)
    (tmp_path / "link").symlink_to("nothing")
    (tmp_path / "cut.mcap").write_bytes(FIXTURE.read_bytes()[:-5000])
    message = (ROOT / "tests" / "data" / "corpus" / "STRING_v1_s1.bin").read_bytes()
    (tmp_path / "whole.igtl").write_bytes(message)
    (tmp_path / "cut.igtl").write_bytes(message[:-1])
    with socket.create_server(("127.0.0.1", 0)) as taken:
        names = {
            "port": str(taken.getsockname()[1]),
            "folder": str(tmp_path),
            "fixture": str(FIXTURE),
            "long": "x" * 300,
        }
        calls = [([word.format(**names) for word in case.call.split()], case.without) for case in cases]
        ended = subprocess.run(
            [sys.executable, "-c", CALLS],
            input=json.dumps(calls),
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
            cwd=tmp_path,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
        )
    found = [json.loads(line) for line in ended.stdout.splitlines()]
    assert len(found) == len(cases), ended.stderr
    for case, (code, out, err) in zip(cases, found, strict=True):
        assert code == case.code, (case.call, out, err)
        assert case.said.format(**names) in out + err, (case.call, out, err)
        assert "Traceback" not in err
        if code and group != "FINDINGS":
            assert len(err.splitlines()) == 1 or "usage:" in err, (case.call, err)


@pytest.mark.parametrize("module", ["rclpy", "rerun", "av", "nibabel"])
def test_the_documentation_has_the_extra_of_each_module(module: str) -> None:
    assert f"| `{missing(module).partition('[')[2].partition(']')[0]}` |" in DOCUMENT
