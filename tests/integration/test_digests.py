"""A recording with digests verifies after whatever is done to it, and has all its bytes: one table of ways."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.reader import make_reader

from igtl_gateway.addons.upload import uploading
from igtl_gateway.addons.upload.place import UploadPlace
from igtl_gateway.addons.upload.uploading import Uploader
from igtl_gateway.app.sealing import verify_seal
from igtl_gateway.app.verification import segments_of, verify_recording, verify_segment_of
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.corrections import StampCorrection
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay import segments
from igtl_gateway.replay.segments import Segment, SegmentResult, verify_in_segments
from tests.addons.upload.store import running_store
from tests.record.sessionfile.test_derived import options_of, plain, recorded, session, written
from tests.record.test_recorder import wait_until, workers

#: Names of streams that the digests stand for.
_DIGESTS = "/igtl_gateway/digest/"


@dataclass(frozen=True)
class Ground:
    """A session, a recording of it with digests, and an empty folder."""

    log: Sequence[Entry]
    source: Path
    folder: Path
    patch: pytest.MonkeyPatch

    @property
    def out(self) -> Path:
        return self.folder / "out.mcap"

    def run(self, words: str, code: int = 0) -> Path:
        """Run a verb, with FILE and OUT; return OUT."""
        given = [{"FILE": str(self.source), "OUT": str(self.out)}.get(word, word) for word in words.split()]
        assert main(given) == code, words
        return self.out

    def key(self) -> Path:
        path = self.folder / "key"
        path.touch(0o600)
        path.write_bytes(SigningKey.generate().private_pem())
        return path


def killed(ground: Ground) -> list[Path]:
    """The process of the recorder is killed when most of it is flushed."""
    path = ground.folder / "killed.mcap"
    recorder = Recorder(**options_of(path, flush_s=0.01), clock=SystemClock())
    (worker,) = workers(os.getpid())
    for entry in ground.log:
        recorder(entry)
    wait_until(lambda: recorder.counters()["written_entries"] == len(ground.log))
    size = path.stat().st_size
    os.kill(worker, signal.SIGKILL)
    recorder.close({})
    assert path.stat().st_size >= size > 0
    shutil.copy(path, ground.source)
    return [ground.run("recover FILE -o OUT", code=1)]


def split(ground: Ground) -> list[Path]:
    recorded(ground.out, ground.log, split_bytes=1 << 20, compression="none")
    folder = ground.out.with_suffix("")
    return [folder, *folder.glob("*.mcap")]


def snapshot(ground: Ground) -> list[Path]:
    """The last seconds of a session, of which the ring has forgotten the first ones."""
    paths: list[Path] = []
    recorded(
        ground.out,
        ground.log,
        snapshot_s=60.0,
        snapshot_bytes=3 << 20,
        before_close=lambda each: paths.append(each.snapshot().result(20)),
    )
    return paths


def sealed(ground: Ground) -> list[Path]:
    recorded(ground.out, ground.log, seal=ground.key())
    assert verify_seal(ground.out).good
    return [ground.out]


def sealed_later(ground: Ground) -> list[Path]:
    ground.run(f"seal FILE --key {ground.key()} -o OUT")
    assert verify_seal(ground.out).good
    return [ground.out]


def merged(ground: Ground) -> list[Path]:
    other = ground.folder / "other.mcap"
    written(other, session(2).log, "digest")
    ground.run(f"merge FILE {other} -o OUT --offset other=0")
    return [ground.out / ground.source.stem]


def uploaded(ground: Ground) -> list[Path]:
    """What the store has."""
    keys = ("AWS_ENDPOINT_URL", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")
    with running_store() as store:
        for name, value in zip(keys, (store.url, "key", "secret"), strict=True):
            ground.patch.setenv(name, value)
        ground.patch.setattr(uploading, "PART_BYTES", 1 << 20)
        uploader = Uploader(
            ground.source.parent, None, UploadPlace("bucket", "or1"), 0.0, SystemClock(), lambda _note: None
        )
        while uploader.waiting() and not uploader.counts.problem:
            uploader.step()
        uploader.close()
        assert not uploader.counts.problem
        ((data, _),) = store.objects.values()
    ground.out.write_bytes(data)
    return [ground.out]


def corrected(ground: Ground) -> list[Path]:
    from igtl_gateway.addons.sync.correcting import write_corrected

    stream = ("TRANSFORM/Tool", "TRANSFORM")
    correction = StampCorrection("TRANSFORM/Tool", "/late", 5, 4, 6, 0.0, 0, True, *stream)
    assert write_corrected(ground.source, ground.out, {stream: correction}, check=lambda _path: None)
    return [ground.out]


def in_segments(ground: Ground) -> list[Path]:
    """As tasks of a cohort, of which each has one segment."""
    ground.patch.setattr(segments, "LEAST_ENTRIES", 10)

    def run(wanted: Sequence[Segment]) -> list[SegmentResult | None]:
        found = []
        for each in wanted:
            with SessionFile.open(ground.source) as file:
                found.append(verify_segment_of(file, Segment.from_dict(each.to_dict())))
        return found

    with SessionFile.open(ground.source) as file:
        parts = segments_of(file, 3)
        assert len(parts) > 1
        report = verify_in_segments(parts, run, file.entry_count)
    assert report and report.good and report.outputs
    return [ground.source]


#: What is done → how, and whether the result has digests.
WAYS: dict[str, tuple[Callable[[Ground], list[Path]], bool]] = {
    "kill": (killed, True),
    "split": (split, True),
    "slice": (lambda ground: [ground.run("slice FILE -o OUT --start 0.05 --end 0.3")], True),
    "merge": (merged, False),
    "seal": (sealed, True),
    "seal later": (sealed_later, True),
    "deidentify": (lambda ground: [ground.run("deidentify FILE -o OUT")], False),
    "recover": (lambda ground: [ground.run("recover FILE -o OUT")], True),
    "snapshot": (snapshot, True),
    "upload": (uploaded, True),
    "segments of a cohort": (in_segments, True),
    "sync --apply": (corrected, False),
    "export --to mcap": (lambda ground: [ground.run("export FILE --to mcap -o OUT")], False),
}


@pytest.fixture(scope="module")
def log() -> list[Entry]:
    return session(3).log


@pytest.mark.parametrize("way", WAYS)
def test_a_recording_with_digests_verifies(
    way: str, log: list[Entry], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    do, keeps = WAYS[way]
    folder = tmp_path / "in"
    folder.mkdir()
    written(folder / "digest.mcap", log, "digest")
    found = do(Ground(log, folder / "digest.mcap", tmp_path, monkeypatch))
    every = {each[4:6] for each in plain(log)}
    has_digests = False
    for path in found:
        report = verify_recording(path)
        assert report.good and report.equal and report.equal == report.outputs, (path, report)
        with SessionFile.open(path) as file:
            entries = plain(file.entries())
            has_digests |= file.has_digests
        if way not in ("deidentify", "sync --apply"):
            assert {each[4:6] for each in entries} <= every, path
        if path.is_file():
            with path.open("rb") as stream:
                topics = {channel.topic for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages()}
            assert keeps or not any(topic.startswith(_DIGESTS) for topic in topics)
    assert has_digests == keeps
