"""Kinematics in HDF5: h5py reads the files beside, and each value and stamp is compared; what is wrong is one line."""

from __future__ import annotations

import io
import json
import subprocess
import threading
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest

import igtl_gateway
from igtl_gateway.addons.lerobot import kinematics_hdf5
from igtl_gateway.base.errors import GatewayError, LimitExceeded
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.cli import main
from tests.addons.lerobot.test_kinematics import imported, recipe
from tests.tables import table

Array = npt.NDArray[Any]
BEGIN_NS = 1_700_000_000 * NS_PER_S + 123_456_789
ROWS = 8
JOINTS = tuple(f"observations/qpos:{number}" for number in range(1, 8))
#: Joints as ACT and robomimic have them, a matrix for each row, packed positions, and stamps.
ARM = f"""\
[[table]]
file = "arm.hdf5"
time = "stamp"
unit = "ns"
zero = "utc"
[[table.pose]]
name = "/tool"
position = ["/data/demo_0/eef_pos:1", "/data/demo_0/eef_pos:2", "/data/demo_0/eef_pos:3"]
unit = "mm"
rotation = {[f"matrix:{number}" for number in (1, 2, 3, 5, 6, 7, 9, 10, 11)]}
[[table.joints]]
name = "/arm"
position = {list(JOINTS)}
effort = {["jaw", *(f"action:{number}" for number in range(1, 7))]}
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file that has all kinds of numbers, and what has none."""
    folder = tmp_path_factory.mktemp("hdf5")
    random = np.random.default_rng(5)
    angles = 0.1 * np.arange(ROWS)
    matrices = np.tile(np.eye(4), (ROWS, 1, 1))
    matrices[:, 0, 0] = matrices[:, 1, 1] = np.cos(angles)
    matrices[:, 1, 0] = np.sin(angles)
    matrices[:, 0, 1] = -matrices[:, 1, 0]
    with h5py.File(folder / "arm.hdf5", "w") as file:
        file["stamp"] = BEGIN_NS + np.arange(ROWS) * 33_333_333
        file["observations/qpos"] = random.normal(size=(ROWS, 7)).astype("f4")
        file.create_dataset("data/demo_0/eef_pos", data=random.normal(size=(ROWS, 3)), chunks=(3, 2), compression=9)
        file["matrix"] = matrices
        file["jaw"] = random.normal(size=(ROWS, 1)).astype(">f8")
        file["action"] = random.integers(-100, 100, size=(ROWS, 6)).astype("i2")
        file["short"], file["single"], file["text"] = np.arange(7.0), 1.0, ["word"] * ROWS
        file["pairs"], file["is_open"] = np.zeros(ROWS, [("a", "f4"), ("b", "f4")]), np.ones(ROWS, bool)
        file["soft"], file["far"] = h5py.SoftLink("/jaw"), h5py.ExternalLink("arm.hdf5", "/jaw")
        file.create_dataset("outside", (ROWS,), "f8", external=[("numbers", 0, 8 * ROWS)])
        layout = h5py.VirtualLayout((ROWS, 1), "f8")
        layout[...] = h5py.VirtualSource("other.h5", "jaw", (ROWS, 1))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("large", (20_000_000, 1), "f8", chunks=(1000, 1))
        file.create_dataset("empty", (0, 3), "f8", maxshape=(None, 3))
        file["type"] = np.dtype("f8")
    (folder / "cut.h5").write_bytes((folder / "arm.hdf5").read_bytes()[:600])
    (folder / "text.h5").write_text("a,b\n1,2\n", "utf-8")
    return folder


def test_each_value_and_stamp(data: Path, tmp_path: Path) -> None:
    with h5py.File(data / "arm.hdf5") as file:
        stamps, joints = file["stamp"][...], file["observations/qpos"][...].astype(float)
        positions, matrices = file["data/demo_0/eef_pos"][...] * 1e-3, file["matrix"][...]
        efforts = np.concatenate([file["jaw"][...], file["action"][...]], axis=1)
    with igtl_gateway.open(imported(data, ARM, tmp_path / "s.mcap")) as recording:
        arm = [message.content for message in recording["/arm"].messages()]
        assert recording["/arm"].source_times.tolist() == recording["/tool"].source_times.tolist() == stamps.tolist()
        assert arm[0].name == list(JOINTS)
        assert np.array_equal([each.position for each in arm], joints)
        assert np.array_equal([each.effort for each in arm], efforts)
        poses = recording["/tool"].poses()
        assert np.array_equal(poses.positions, positions)
        assert np.allclose(poses.matrices[:, :3, :3], matrices[:, :3, :3], atol=1e-12)


def joints(column: object, time: str = 'time = "stamp"\nunit = "ns"', file: str = "arm.hdf5") -> str:
    name = json.dumps(column)
    return f'[[table]]\nfile = "{file}"\n{time}\n[[table.joints]]\nname = "/arm"\nposition = [{name}]\n'


PLACE = "table[0].joints[0].position: arm.hdf5: "
BAD = [
    (joints("far"), f"{PLACE}far: found a link to another place ('far'), expected data in the file itself"),
    (joints("jaw", "rate = 30", "cut.h5"), "cut.h5: is not a valid HDF5 file: "),
    (joints("qpos"), f"{PLACE}qpos: found no 'qpos', expected one of action, data"),
    (joints("single"), f"{PLACE}single: found a single value, expected rows"),
    (joints("soft"), f"{PLACE}soft: found a link to another place ('soft'), expected data in the file itself"),
    (joints("observations"), f"{PLACE}observations: found a group, expected a dataset in it, one of qpos"),
    (joints("observations/qpos"), "qpos: found 7 numbers in each row, expected one, by :1 to :7"),
    (joints("observations/qpos:8"), f"{PLACE}observations/qpos:8: found number 8, expected 1 to 7"),
    (joints("jaw:0"), f"{PLACE}jaw:0: found number 0, expected 1 to 1"),
    (joints("jaw/x:1"), f"{PLACE}jaw/x:1: found a dataset /jaw, expected a group"),
    (joints("text"), f"{PLACE}text: found strings, expected numbers of at most 64 bits"),
    (joints("pairs"), f"{PLACE}pairs: found compound values, expected numbers of at most 64 bits"),
    (joints("is_open"), f"{PLACE}is_open: found an enumeration, expected numbers of at most 64 bits"),
    (joints("type"), f"{PLACE}type: found a type, expected a dataset"),
    (joints("outside"), f"{PLACE}outside: found data in other files, expected them in the file itself"),
    (joints("virtual"), f"{PLACE}virtual: found data in other files, expected them in the file itself"),
    (joints("large"), f"{PLACE}large: bytes: found 160000000, expected at most 67108864 (--limit ratio=250)"),
    (joints("short"), f"{PLACE}short: found 7 rows, expected 8 as stamp has"),
    (joints("empty:1", "rate = 30"), "arm.hdf5: empty: found no row, expected one or more"),
    (joints(3), f'{PLACE}found 3, expected a dataset such as "group/data" or "group/data:3"'),
    (joints("jaw", 'time = "jaw"'), "arm.hdf5: row "),
    (joints("jaw", "rate = 30\nheader = false"), "table[0]: found header or separator with HDF5, expected them with"),
    (joints("jaw", "rate = 30", "text.h5"), "text.h5: is not a valid HDF5 file: "),
    ('[[table]]\nfile = "arm.hdf5"\nrate = 30\n', "table[0]: found no column of arm.hdf5, expected pose or joints"),
]


@table(("text", "expected"), BAD, gate=lambda text, expected: expected in {each[1] for each in BAD[:2]})
def test_a_wrong_column_or_file_is_one_line(
    text: str, expected: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["import", str(recipe(data, text)), "-o", str(tmp_path / "s.mcap")]) != 0
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and expected in told[0] and len(told[0]) < 500, told
    assert not (tmp_path / "s.mcap").exists()


GOOD = b'{"datasets": [{"shape": [2], "dtype": "<f4", "packed": 8, "chunk": 0}]}\n'
REPLIES = [
    (GOOD + b"{}\n" + bytes(8), ""),
    (GOOD + b"{}\n" + bytes(7), "found data that end the program that reads it"),
    (GOOD + b'{"error": "a damaged chunk"}\n' + bytes(8), "is not a valid HDF5 file: a damaged chunk"),
    (b"", "found data that end the program that reads it"),
    (b"{}\n", "found data that end the program that reads it"),
    (GOOD.replace(b"<f4", b"|O"), "found data that end the program that reads it"),
    (GOOD.replace(b"[2]", b"[-2]"), "found data that end the program that reads it"),
    (GOOD.replace(b"[2]", b"[0, 9000000000]"), "found 36000000000, expected at most 1073741824 (--limit memory="),
    (GOOD.replace(b'"chunk": 0', b'"chunk": 9000000000'), "found 9000000000, expected at most 1073741824"),
    (GOOD.replace(b"]}\n", b", 1]}\n"), "found data that end the program that reads it"),
    (b'{"memory": true}\n', "found a file that needs more bytes, expected at most 1073741824"),
    (b'{"absent": "libhdf5.so: no such file"}\n', "h5py cannot be imported (libhdf5.so: no such file): pip install"),
    (b'{"name": 0, "error": "found \\u001b[1m"}\n', "table[0].time: t.h5: stamp: found \\x1b[1m"),
]  # fmt: skip


class Program:
    """In place of a process: its output is given."""

    def __init__(self, output: bytes) -> None:
        self.stdin, self.stdout = io.BytesIO(), io.BytesIO(output)
        self.is_killed = False

    def kill(self) -> None:
        self.is_killed = True

    def communicate(self) -> None:
        assert self.is_killed


@table(("output", "expected"), REPLIES)
def test_what_the_program_may_reply(
    output: bytes, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "t.h5").touch()
    program = Program(output)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: program)
    error = ""
    try:
        kinematics_hdf5.open_hdf5(tmp_path / "t.h5", {"stamp": "table[0].time"})
    except GatewayError as found:
        error = str(found)
    assert program.is_killed
    assert expected in error and bool(expected) == bool(error), error


class Silent(Program):
    """Replies when it is killed only."""

    def __init__(self) -> None:
        super().__init__(b"")
        self.killed = threading.Event()
        self.stdout.readline = self.wait  # type: ignore[method-assign,assignment]

    def wait(self, size: int) -> bytes:
        assert self.killed.wait(60)
        return b""

    def kill(self) -> None:
        super().kill()
        self.killed.set()


def test_a_program_that_does_not_reply_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "t.h5").touch()
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: Silent())
    with limits_in_force(FileLimits(seconds=0)), pytest.raises(LimitExceeded, match="found more than 0 s of work"):
        kinematics_hdf5.open_hdf5(tmp_path / "t.h5", {"stamp": "table[0].time"})
