"""The account of a sequence agrees with the counts of an independent reader."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from igtl_gateway.addons.exchange.sequence import TRANSFORM_STATUS
from igtl_gateway.addons.exchange.sequence_out import export_sequence
from igtl_gateway.base.errors import LimitExceeded, UnsupportedRecording
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.transform import Transform
from tests.addons.exchange import plus
from tests.addons.exchange.memory import InMemory, said, sent

SLICE = Image((2, 2, 1), 3, bytes(4))


def pose(x: float) -> Transform:
    return Transform((1, 0, 0, 0, 1, 0, 0, 0, 1, x, 0, 0))


def test_poses_between_images_are_left_out(tmp_path: Path) -> None:
    items = [sent(10 * number, "Tool", "TRANSFORM", pose(number)) for number in range(100)]
    items += [sent(250 * number + 5, "Scan", "IMAGE", SLICE) for number in range(4)]
    items.sort(key=lambda item: item.time_ns)
    path = tmp_path / "some.igs.mha"
    account = export_sequence(InMemory(items), path, ())
    rows = {row.stream: row for row in account.rows}
    frames = plus.read(path).frames
    held = [fields["ToolTransform"] for fields in frames.values() if fields["ToolTransformStatus"] == "OK"]
    assert len(frames) == rows["IMAGE/Scan"].taken == 4
    assert len(held) == len(set(held)) == rows["TRANSFORM/Tool"].taken == 4
    assert (rows["TRANSFORM/Tool"].declared, rows["TRANSFORM/Tool"].left_out) == (100, 96)
    assert "between two images" in rows["TRANSFORM/Tool"].why
    assert "ToolTransform: OK in 4 of 4 frames" in account.notes
    assert all(row.good for row in account.rows)


def test_each_reason_is_counted(tmp_path: Path) -> None:
    items = [
        sent(0, "Tool", "TRANSFORM", pose(1)),
        sent(10, "Scan", "IMAGE", SLICE),
        sent(20, "Tool", "TRANSFORM", pose(math.nan)),
        sent(30, "Scan", "IMAGE", SLICE),
        sent(40, "Tool", "TRANSFORM", pose(2)),
        said(50, TRANSFORM_STATUS, "TRANSFORM/Tool"),
        sent(60, "Scan", "IMAGE", SLICE),
        sent(70, "Tool", "TRANSFORM", pose(3)),
        sent(2000, "Scan", "IMAGE", SLICE),
        sent(2010, "Tool", "TRANSFORM", pose(4)),
    ]
    path = tmp_path / "some.igs.mha"
    row = next(row for row in export_sequence(InMemory(items), path, ()).rows if row.type == "TRANSFORM")
    assert (row.declared, row.taken, row.left_out) == (5, 1, 4)
    assert row.why == (
        "1: not finite; 1: marked as invalid before the next frame; 1: older than 1 s at the next image; "
        "1: between two images: a frame contains the latest transform before it"
    )
    statuses = [fields["ToolTransformStatus"] for fields in plus.read(path).frames.values()]
    assert statuses == ["OK", "INVALID", "INVALID", "INVALID"]
    assert "nan" not in path.read_bytes().decode("latin-1")


def test_a_pose_may_be_in_several_frames(tmp_path: Path) -> None:
    items = [sent(0, "Tool", "TRANSFORM", pose(1)), *(sent(100 * n + 1, "Scan", "IMAGE", SLICE) for n in range(3))]
    account = export_sequence(InMemory(items), tmp_path / "some.igs.mha", ())
    assert [(row.declared, row.taken, row.left_out) for row in account.rows] == [(1, 1, 0), (3, 3, 0)]
    assert "ToolTransform: OK in 3 of 3 frames" in account.notes


def test_without_images_each_moment_is_a_frame(tmp_path: Path) -> None:
    items = [sent(at, name, "TRANSFORM", pose(at)) for at in (0, 100) for name in ("Tool", "Probe")]
    items.append(sent(100, "Tool", "TRANSFORM", pose(7)))
    path = tmp_path / "some.igs.mha"
    account = export_sequence(InMemory(items), path, ())
    assert len(plus.read(path).frames) == 2
    assert {row.stream: (row.taken, row.left_out) for row in account.rows} == {
        "TRANSFORM/Tool": (2, 1),
        "TRANSFORM/Probe": (2, 0),
    }


def test_images_unlike_the_first_are_missed(tmp_path: Path) -> None:
    items = [sent(0, "Scan", "IMAGE", SLICE), sent(1, "Scan", "IMAGE", Image((3, 2, 1), 3, bytes(6)))]
    (row,) = export_sequence(InMemory(items), tmp_path / "some.igs.mha", ()).rows
    assert (row.taken, row.failed, row.good) == (1, 1, False)


def test_nothing_that_can_be_read_is_no_file(tmp_path: Path) -> None:
    part = Image((3, 2, 1), 3, bytes(3), subvol_size=(3, 1, 1))
    with pytest.raises(UnsupportedRecording, match="neither a complete IMAGE"):
        export_sequence(InMemory([sent(0, "Scan", "IMAGE", part)]), tmp_path / "some.igs.mha", ())
    assert not (tmp_path / "some.igs.mha").exists()


def test_more_transforms_than_a_sequence_that_is_read_back_are_refused(tmp_path: Path) -> None:
    """Each frame has all of them: 20,000 poses of 20,000 devices would be 400 million."""
    items = [sent(number, f"Tool{number}", "TRANSFORM", pose(number)) for number in range(12)]
    out = tmp_path / "some.igs.mha"
    with limits_in_force(FileLimits(fields=11)), pytest.raises(LimitExceeded, match="12, expected at most 11"):
        export_sequence(InMemory(items), out, ())
    assert not out.exists()
    with limits_in_force(FileLimits(fields=12)):
        export_sequence(InMemory(items), out, ())
