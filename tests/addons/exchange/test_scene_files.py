"""Text files of a scene: sequences of poses, tables, and the model of axes, as other programs read them."""

from __future__ import annotations

import csv
import io
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.exchange.scene_files import axes_file, pose_file, table_files


def poses(ms: list[int], numbers: list[float] | None = None) -> dict[str, str]:
    """The fields of a sequence in their order."""
    matrices = np.tile(np.eye(4), (len(ms), 1, 1))
    if numbers:
        matrices[:, 0, 3] = numbers
    lines = pose_file("Probe", np.array(ms, np.int64), matrices).decode("ascii").splitlines()
    return dict(line.split(" = ", 1) for line in lines)


def test_each_pose_is_a_frame_with_its_time() -> None:
    found = poses([0, 20, 1500], [1.0, -2.5, 3.0])
    assert found["DimSize"] == "0 0 3" and list(found)[-1] == "ElementDataFile" and found["ElementDataFile"] == "LOCAL"
    assert [found[f"Seq_Frame000{number}_Timestamp"] for number in range(3)] == ["0.000", "0.020", "1.500"]
    assert found["Seq_Frame0001_ProbeTransform"] == "1 0 0 -2.5 0 1 0 0 0 0 1 0 0 0 0 1"
    assert {found[f"Seq_Frame000{number}_ProbeTransformStatus"] for number in range(3)} == {"OK"}


def test_before_a_first_pose_that_is_later_there_is_an_invalid_one() -> None:
    """A reader would show the first pose from 0 on."""
    for ms in (1, 7):
        found = poses([ms])
        assert found["DimSize"] == "0 0 2"
        assert (found["Seq_Frame0000_Timestamp"], found["Seq_Frame0000_ProbeTransformStatus"]) == ("0.000", "INVALID")
        assert (found["Seq_Frame0001_Timestamp"], found["Seq_Frame0001_ProbeTransformStatus"]) == (f"0.00{ms}", "OK")


def test_a_sequence_without_poses() -> None:
    assert poses([])["DimSize"] == "0 0 0"


def test_numbers_of_frames_may_have_more_than_four_digits() -> None:
    found = poses(list(range(10_001)))
    assert "Seq_Frame10000_ProbeTransform" in found


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=4))
def test_numbers_come_back_to_the_last_bit(numbers: list[float]) -> None:
    found = poses(list(range(len(numbers))), numbers)
    assert [float(found[f"Seq_Frame000{at}_ProbeTransform"].split()[3]) for at in range(len(numbers))] == numbers


def read(data: bytes) -> list[list[str]]:
    return list(csv.reader(io.StringIO(data.decode()), delimiter="\t"))


def test_tables_are_read_by_a_reader_of_tab_separated_values() -> None:
    data, schema = table_files({"time": [0.5, math.nan, 1e300], "what": ["a\tb", 'c "d"', "ä\n e"], "n": [1, 2, 3]})
    assert read(data) == [
        ["time", "what", "n"], ["0.5", "a b", "1"], ["nan", "c 'd'", "2"], ["1.0000000000000001e+300", "ä e", "3"],
    ]  # fmt: skip
    assert read(schema) == [["columnName", "type"], ["time", "double"], ["what", "string"], ["n", "double"]]


def test_names_of_columns_are_cells_too() -> None:
    data, _ = table_files({"a\tb": [1.0]})
    assert read(data)[0] == ["a b"]


def test_a_column_with_any_text_is_text() -> None:
    _, schema = table_files({"mixed": [1.0, "x"], "numbers": [1, 2.5]})
    assert read(schema)[1:] == [["mixed", "string"], ["numbers", "double"]]


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError):
        table_files({"a": [1.0], "b": []})


def test_the_axes_are_a_file_of_vtk() -> None:
    data = axes_file(50.0)
    assert data.startswith(b"# vtk DataFile Version 3.0\naxes, millimetres, SPACE=RAS\nBINARY\nDATASET POLYDATA\n")
    _, rest = data.split(b"POINTS 6 float\n")
    points = np.frombuffer(rest[:72], ">f4").reshape(3, 2, 3)
    assert points[:, 0].tolist() == [[0.0] * 3] * 3
    assert points[:, 1].tolist() == [[50.0, 0.0, 0.0], [0.0, 50.0, 0.0], [0.0, 0.0, 50.0]]
    _, rest = rest.split(b"\nLINES 3 9\n")
    assert struct.unpack(">9i", rest[:36]) == (2, 0, 1, 2, 2, 3, 2, 4, 5)
    _, rest = rest.split(b"COLOR_SCALARS colours 3\n")
    colours = np.frombuffer(rest[:18], np.uint8).reshape(3, 2, 3)
    assert (colours[:, 0] == colours[:, 1]).all()
    assert colours[:, 0].argmax(axis=1).tolist() == [0, 1, 2], "x is red, y green, z blue"
