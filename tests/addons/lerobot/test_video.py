"""Videos whose tables lie, or that take longer to decode than their size allows."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addons.lerobot.video import VideoFile, read_video
from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import limits

pytest.importorskip("av")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A video of 20 pictures."""
    video = VideoFile(tmp_path / "a.mp4", (48, 64), 30, "h264")
    for number in range(20):
        video.add(np.full((48, 64, 3), 10 * number, np.uint8))
    video.close()
    return video.path


def state(path: Path, kind: bytes, offset: int, *words: int) -> None:
    """Write words of 32 bits into a box, from an offset behind its head."""
    data = bytearray(path.read_bytes())
    struct.pack_into(f">{len(words)}I", data, data.index(kind) + len(kind) + offset, *words)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("kind", "offset", "words"),
    [
        (b"stsz", 4, (100, 80_000_000)),
        (b"stts", 4, (1, 80_000_000, 1)),
        (b"stsc", 4, (80_000_000,)),
        (b"stco", 4, (4_000_000_000,)),
        (b"stss", 4, (80_000_000,)),
    ],
)
def test_a_sample_table_that_lies_is_refused(path: Path, kind: bytes, offset: int, words: tuple[int, ...]) -> None:
    assert sum(1 for _ in read_video(path)) == 20
    state(path, kind, offset, *words)
    with pytest.raises(DamagedRecording, match=rf"a\.mp4: {kind.decode()}: found [0-9,]+ samples, expected"):
        list(read_video(path))


def test_what_comes_behind_the_boxes_is_left_to_the_decoder(path: Path) -> None:
    whole = path.read_bytes()
    for tail in (b"\0\0\0\1", b"\0\0\0\1free" + bytes(8), b"\0\0\0\4free", bytes(30)):
        path.write_bytes(whole + tail)
        assert sum(1 for _ in read_video(path)) == 20
    path.write_bytes(whole + b"".join(b"\0\0\0\x08moov" for _ in range(300_000)))
    with pytest.raises(LimitExceeded, match=r"boxes: found 200001, expected at most 200000"):
        list(read_video(path))


def test_decoding_has_a_limit_of_time(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of the caller does not count."""
    now = [0]
    monkeypatch.setattr("igtl_gateway.base.clock.SystemClock.monotonic_ns", lambda _: now[0])
    with limits.limits_in_force(limits.parse_limits(["seconds=3"])):
        for _ in read_video(path):
            now[0] += 60_000_000_000
    steps = iter(range(0, 1_000_000_000_000, 1_000_000_000))
    monkeypatch.setattr("igtl_gateway.base.clock.SystemClock.monotonic_ns", lambda _: next(steps))
    with (
        limits.limits_in_force(limits.parse_limits(["seconds=3"])),
        pytest.raises(LimitExceeded, match=r"a\.mp4: found more than 3 s of work, expected at most 3 s \(--limit sec"),
    ):
        list(read_video(path))


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file that cannot be read")
def test_an_error_of_the_disk_is_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """FFmpeg's reader would print a traceback of it."""
    (tmp_path / "a.mp4").symlink_to("/proc/self/mem")
    with pytest.raises(DamagedRecording, match=r"a\.mp4: cannot be decoded: Input/output error"):
        list(read_video(tmp_path / "a.mp4"))
    assert capfd.readouterr() == ("", "")
