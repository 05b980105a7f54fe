"""Verification of a recording: its file, its configuration, and the result."""

from __future__ import annotations

import json
import mmap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import GatewayError, UnsupportedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.base.systems.forks import can_fork, free_memory, in_processes
from igtl_gateway.base.untrusted import cpu_time
from igtl_gateway.base.version import __version__
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.columns import EntryColumns, Unfit
from igtl_gateway.record.sessionfile.derived import who_computes
from igtl_gateway.record.sessionfile.layout import IMPORTED_KEY
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.compare import LeafDecoder
from igtl_gateway.replay.recheck import can_recheck, message_counts, recheck
from igtl_gateway.replay.recorded_config import absent_sources, config_to_run, units_of
from igtl_gateway.replay.segments import Segment, SegmentResult, plan, verify_in_segments, verify_segment
from igtl_gateway.replay.verify import DIGEST, DeclaredLosses, Difference, VerifyReport, verify

#: Entries of a segment, about, and the most segments for each process.
_ENTRIES_EACH, _MOST_EACH = 500_000, 4
#: What a process may need, bytes.
_MEMORY_OF_WORKER = 256 << 20

#: Entries between two calls of a function that takes the progress.
_STEP = 4_096
#: Takes the entries that are verified so far, and how many there are.
OnProgress = Callable[[int, int], None]

#: Key of the version that recorded the session.
_VERSION = "igtl_gateway_version"
#: ``Verification.config`` of the recorded configuration.
RECORDED = "recorded"


@dataclass(frozen=True, slots=True)
class Verification:
    """The result of a verification: whether the outputs of a recording follow from its inputs.

    Attributes:
        file: the recording.
        recorded_by, verified_by: versions of igtl-gateway; "" = unknown.
        config: ``"recorded"``, or the configuration file that replaced the recorded configuration.
        inputs, outputs: number of recorded entries that were processed, and that were compared.
        equal: number of outputs that are equal, byte for byte.
        lost: number of computed outputs that the recording has lost, as it declares.
        missing: number of other declared losses: inputs and their outputs.
        orphans: number of recorded outputs of such inputs, which cannot be verified.
        late: number of notes at other times than recorded, because the entries that they report were lost.
        differing: number of outputs that are different, missing or additional.
        by_stream: differing outputs by stream.
        firsts: first difference of each stream.
        differences: the first 1,000 differences.
        compiled: number of inputs whose outputs compiled conversions computed, instead of the full path.
        damaged_indexes: number of chunks whose index of messages is damaged: other programs do not find all messages.
        absent: a sentence about each topic and device of another configuration that the recording does not have.
    """

    file: Path
    recorded_by: str
    verified_by: str
    config: str
    inputs: int
    outputs: int
    equal: int
    lost: int
    missing: int
    orphans: int
    late: int
    differing: int
    by_stream: dict[str, int]
    firsts: dict[str, Difference]
    differences: tuple[Difference, ...]
    compiled: int = 0
    damaged_indexes: int = 0
    absent: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether no output differs, and all losses are declared."""
        return self.differing == 0

    @property
    def advice(self) -> str:
        """Which version can compute outputs whose digests differ; ``""`` if none differs, or this version recorded."""
        if self.recorded_by == self.verified_by or self.config != RECORDED:
            return ""
        return who_computes(self.recorded_by) if any(each.field == DIGEST for each in self.differences) else ""

    def __repr__(self) -> str:
        different = f", {self.differing:,} DIFFERENT" if self.differing else ""
        return f"<Verification {self.file}: {self.equal:,} of {count_text(self.outputs, 'output')} equal{different}>"

    def to_dict(self) -> dict[str, Any]:
        """Return the result as JSON values, as ``igtl-gateway verify --json`` prints it."""
        values = asdict(self) | {"file": str(self.file)}
        return {"file": values.pop("file"), "good": self.good, **values}


def verify_parts(
    path: Path, config_path: Path | None = None, *, reference: bool = False, on_progress: OnProgress | None = None
) -> list[Verification]:
    """Verify each part of a merged session; of another recording return nothing.  Raises as ``verify_recording``."""
    with SessionFile.open(path) as file:
        names = file.merge.names if file.merge else []
    return [verify_recording(path / name, config_path, reference=reference, on_progress=on_progress) for name in names]


def verify_recording(
    path: Path,
    config_path: Path | None = None,
    *,
    reference: bool = False,
    workers: int = 1,
    on_progress: OnProgress | None = None,
) -> Verification:
    """Verify a recording.

    Args:
        path: the recording.
        config_path: configuration file to use instead of the recorded configuration.
        reference: compute all outputs by the full path.
        workers: processes that verify segments of a long recording; fewer without memory for them.
        on_progress: takes the progress; it begins again where something differs and all is compared in full.

    Raises UnsupportedRecording for other files and for imports, DamagedRecording, ConfigError.
    """
    with SessionFile.open(path) as file:
        return verify_session(file, config_path, reference=reference, workers=workers, on_progress=on_progress)


def verify_session(
    file: SessionFile,
    config_path: Path | None = None,
    *,
    reference: bool = False,
    workers: int = 1,
    on_progress: OnProgress | None = None,
) -> Verification:
    """Verify an open recording; see `verify_recording`."""
    chosen = _Chosen.of(file, config_path)
    report = _in_segments(file, chosen, reference, workers, on_progress) if workers > 1 else None
    if report is None and not reference:
        report = _recheck(file, chosen, on_progress)
    if report is None or not report.good:
        entries = _counted(file.entries(computed=False), file.entry_count, on_progress)
        report = verify(entries, chosen.config, chosen.losses, before=file.prologue(), decoder=chosen.decoder)
    counts = {each.name: getattr(report, each.name) for each in fields(VerifyReport)}
    counts["differences"] = tuple(report.differences)
    config_name = str(config_path) if config_path else RECORDED
    absent = tuple(absent_sources(file, chosen.config)) if config_path else ()
    return Verification(
        file.path,
        recorded_by(file),
        __version__,
        config_name,
        **counts,
        damaged_indexes=file.damaged_indexes(),
        absent=absent,
    )


def recorded_by(file: SessionFile) -> str:
    """Return the version of igtl-gateway that recorded a session; "" = unknown."""
    return file.session.get(_VERSION, "")


def segments_of(file: SessionFile, most: int) -> list[Segment]:
    """Return segments of a recording, for `verify_segment_of` and `verify_in_segments`; none: it is verified as one.

    Raises as `verify_recording`.
    """
    return plan(file, _Chosen.of(file).losses, most)


def verify_segment_of(file: SessionFile, segment: Segment) -> SegmentResult | None:
    """Verify a segment of a recording; None where only the whole can be verified.  Raises as `verify_recording`."""
    return _Chosen.of(file).verified(file, segment, reference=False)


@dataclass(frozen=True, slots=True)
class _Chosen:
    """What a recording is verified with."""

    config: Config
    losses: DeclaredLosses
    decoder: LeafDecoder

    @classmethod
    def of(cls, file: SessionFile, config_path: Path | None = None) -> _Chosen:
        """Raises UnsupportedRecording for other files than recordings, ConfigError."""
        _check(file)
        config = _config(file.path, config_path, file, recorded_by(file))
        decoder = LeafDecoder(file.definitions, units_of(config, file))
        return cls(config, DeclaredLosses.of(file.session, file.ledger), decoder)

    def verified(
        self,
        file: SessionFile,
        segment: Segment,
        *,
        reference: bool,
        on_entries: Callable[[int], None] = lambda _: None,
    ) -> SegmentResult | None:
        """The result of a segment; None where only the whole can be verified."""
        compiles = not reference and can_recheck(self.config)
        try:
            return verify_segment(
                file, segment, self.config, self.losses, self.decoder, compiles=compiles, on_entries=on_entries
            )
        except Unfit:
            return None


def _check(file: SessionFile) -> None:
    path = file.path
    if file.merge:
        raise UnsupportedRecording(f"{path}: found a merged session, expected a part: {path / file.merge.names[0]}")
    if file.foreign:
        raise UnsupportedRecording(f"{path}: found an MCAP file of another program, expected a session of igtl-gateway")
    if IMPORTED_KEY in file.session:
        raise UnsupportedRecording(
            f"{path}: found an import ({file.session[IMPORTED_KEY]}), expected a recording of the gateway: "
            "it has no outputs; `replay --through-gateway` computes them"
        )


def _in_segments(
    file: SessionFile, chosen: _Chosen, reference: bool, workers: int, on_progress: OnProgress | None
) -> VerifyReport | None:
    """The result of segments in processes; None: the recording has to be verified as a whole."""
    memory = free_memory()
    workers = workers if memory is None else min(workers, memory // _MEMORY_OF_WORKER)
    if workers < 2 or not can_fork():
        return None
    count = workers * max(1, min(_MOST_EACH, file.entry_count // (workers * _ENTRIES_EACH)))

    def verified(segment: Segment, on_entries: Callable[[int], None]) -> SegmentResult | None:
        with suppress(GatewayError, OSError, MemoryError), cpu_time.bounded():
            with SessionFile.open(file.path) as opened:  # with a place in the file of its own
                return chosen.verified(opened, segment, reference=reference, on_entries=on_entries)
        return None

    most = 0

    def run(segments: Sequence[Segment]) -> list[SegmentResult | None]:
        done = memoryview(mmap.mmap(-1, 8 * len(segments))).cast("q")  # shared with the processes

        def work(number: int) -> bytes:
            done[number] = 0

            def count(entries: int) -> None:
                done[number] += entries

            found = verified(segments[number], count)
            return json.dumps(found and found.to_dict()).encode()

        def tick() -> None:
            nonlocal most
            most = max(most, sum(done))  # segments that are verified as one begin again
            if on_progress:
                on_progress(min(most, file.entry_count), file.entry_count)

        shared = in_processes(work, len(segments), workers, tick if on_progress else None)
        replies = [json.loads(reply or b"null") for reply in shared]
        return [reply and SegmentResult(**reply) for reply in replies]

    try:
        segments = plan(file, chosen.losses, count)
    except (GatewayError, OSError):  # the verification of the whole meets it, too
        return None
    return verify_in_segments(segments, run, file.entry_count) if segments else None


def _recheck(file: SessionFile, chosen: _Chosen, on_progress: OnProgress | None) -> VerifyReport | None:
    """The result with compiled conversions, whose differences are not all certain; None: they cannot be used."""
    if not can_recheck(chosen.config):
        return None
    try:
        columns = _counted_columns(file.columns(computed=False), file.entry_count, on_progress)
    except Unfit:
        return None
    config, losses, decoder = chosen.config, chosen.losses, chosen.decoder
    return recheck(columns, config, losses, counts=message_counts(file), before=file.prologue(), decoder=decoder)


def _config(path: Path, config_path: Path | None, file: SessionFile, recorded_by: str) -> Config:
    """The configuration to verify with.  Raises ConfigError, or UnsupportedRecording with both versions."""
    try:
        return config_to_run(file.session, config_path)
    except UnsupportedRecording as error:
        raise UnsupportedRecording(
            f"{path}: {error}; recorded by igtl-gateway {recorded_by or 'of an unknown version'}, "
            f"this is {__version__}: give a configuration with --config"
        ) from None


def _counted(entries: Iterable[Entry], of: int, on_progress: OnProgress | None) -> Iterator[Entry]:
    """Yield entries, and report how many of all have been."""
    if on_progress is None:
        yield from entries
        return
    for number, entry in enumerate(entries):
        if number % _STEP == 0:
            on_progress(number, of)
        yield entry


def _counted_columns(blocks: Iterable[EntryColumns], of: int, on_progress: OnProgress | None) -> Iterator[EntryColumns]:
    done = 0
    for columns in blocks:
        if on_progress:
            on_progress(done, of)
        yield columns
        done += len(columns)
