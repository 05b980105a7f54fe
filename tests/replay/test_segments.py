"""A verification in segments has the result of the whole, and never another one, whatever the segments begin with."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.app import verification
from igtl_gateway.app.verification import Verification, verify_recording
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.assembly import VolumeAssembler
from igtl_gateway.gateway import Gateway, Session
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.gateway.guarded_stream import STILL_LOOKS
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.ledger import Ledger
from igtl_gateway.gateway.log.timing import StampTiming
from igtl_gateway.gateway.state import NoDigest, state_digest
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway.replay import segments
from igtl_gateway.replay.recheck import Checker
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.verify import DeclaredLosses, Verifier, VerifyReport, compare
from tests.places import FIXTURES, ROOT
from tests.record import samples
from tests.record.test_parts import record, session
from tests.tables import table
from tools.recheck import CHANGES, in_segments, is_equal, judged, random_session, written

#: Of which the file has several chunks.
LONG = ("lego", "star", "ultrasound")
COMPILES = is_compiled()


def planned(path: Path, most: int = 4) -> list[segments.Segment]:
    with SessionFile.open(path) as file:
        return segments.plan(file, DeclaredLosses.of(file.session, file.ledger), most)


def results(
    path: Path, chosen: Sequence[segments.Segment], *, compiles: bool = COMPILES
) -> list[segments.SegmentResult]:
    with SessionFile.open(path) as file:
        losses, config = DeclaredLosses.of(file.session, file.ledger), config_to_run(file.session)
        return [segments.verify_segment(file, each, config, losses, compiles=compiles) for each in chosen]


def joined(path: Path, found: list[segments.Segment]) -> VerifyReport | None:
    with SessionFile.open(path) as file:
        return segments.verify_in_segments(found, lambda some: results(path, some), file.entry_count)


def of_whole(path: Path) -> Verification | str:
    try:
        return verify_recording(path, reference=True)
    except GatewayError as error:
        return str(error)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "LEAST_ENTRIES", 20)


@table(
    "path",
    sorted(FIXTURES.glob("*.mcap")),
    ids=lambda path: str(path.stem),
    gate=lambda path: path.stem in ("every-type", "lego", "star"),
)
def test_a_fixture_has_the_same_result(path: Path) -> None:
    report = in_segments(path)
    assert report is None or is_equal(report, of_whole(path))
    assert report or path.stem not in LONG


@table("compiles", [False, True])
@table("name", LONG, gate=lambda name: name == "star")
def test_each_segment_begins_with_the_state_at_the_end_of_the_one_before(name: str, compiles: bool) -> None:
    path = FIXTURES / f"{name}.mcap"
    found = results(path, planned(path, 6), compiles=compiles and COMPILES)
    assert len(found) > 1 and all(each.good and each.after for each in found)
    assert [each.after for each in found[:-1]] == [each.before for each in found[1:]]


@pytest.mark.slow
def test_streams_that_are_collected_in_any_order_leave_one_state(tmp_path: Path) -> None:
    """Pictures that pass natively are collected after later poses: the chunks of a recorder with zstd end between."""
    path = tmp_path / "star.mcap"
    with SessionFile.open(FIXTURES / "star.mcap") as file:
        writer = SessionWriter(path, dict(file.session), compression="zstd", together=True)
        for entry in file.entries():
            writer.write(entry)
        writer.close({"streams": {}})
    found = results(path, planned(path, 6), compiles=COMPILES)
    assert len(found) > 1 and all(each.good and each.after for each in found)
    assert [each.after for each in found[:-1]] == [each.before for each in found[1:]]


@table("seed", range(3), gate=lambda seed: seed < 1)
def test_a_random_session_has_the_same_result(seed: int, tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", *random_session(random.Random(seed), 1_200))
    report = in_segments(path)
    assert len(planned(path)) > 2 and (report is None or is_equal(report, of_whole(path)))


@table("change", sorted(CHANGES))
def test_a_change_in_the_recording_is_never_hidden(change: str, tmp_path: Path) -> None:
    chance = random.Random(change)
    config, entries = random_session(chance)
    path = written(tmp_path / "a.mcap", config, CHANGES[change](entries, chance))
    report = in_segments(path)
    assert report is None or is_equal(report, of_whole(path))


def test_the_parts_of_a_recording_are_verified_in_segments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "SESSION", {layout.CONFIGURATION_KEY: json.dumps(Config().to_dict())})
    folder = record(tmp_path / "long.mcap", session(), split_s=1.0).path
    found = planned(folder)
    report = joined(folder, found)
    assert len(found) > 2 and report and is_equal(report, of_whole(folder))


@table("lost", ["counted", "no ledger"])
def test_a_recording_with_losses_is_verified_as_a_whole(lost: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", *random_session(random.Random(1)))
    with SessionFile.open(path) as file:
        losses = DeclaredLosses(entries=1) if lost == "counted" else DeclaredLosses(uncounted=True)
        assert segments.plan(file, DeclaredLosses(), 4) and not segments.plan(file, losses, 4)


# -- states that are wrong -----------------------------------------------------------------------------------------


def _without_state(found: list[segments.Segment]) -> list[segments.Segment]:
    return [replace(each, state=()) for each in found]


def _without_the_last(found: list[segments.Segment]) -> list[segments.Segment]:
    cut = [replace(each.state[-1], times=each.state[-1].times[:-1]) for each in found[1:]]
    return [
        found[0],
        *(replace(each, state=(*each.state[:-1], one)) for each, one in zip(found[1:], cut, strict=True)),
    ]


def _of_the_next(found: list[segments.Segment]) -> list[segments.Segment]:
    later = [*found[2:], found[1]]
    return [found[0], *(replace(each, state=other.state) for each, other in zip(found[1:], later, strict=True))]


WRONG: dict[str, Callable[[list[segments.Segment]], list[segments.Segment]]] = {
    "nothing": _without_state,
    "all but the last input": _without_the_last,
    "another segment's": _of_the_next,
}


@table("wrong", sorted(WRONG))
@table("name", ["star", "ultrasound"], gate=lambda name: name == "star")
def test_a_wrong_state_is_no_joint(name: str, wrong: str) -> None:
    path = FIXTURES / f"{name}.mcap"
    right = planned(path)
    found = results(path, WRONG[wrong](right))
    assert all(one.after != two.before for one, two in pairwise(found))
    assert joined(path, WRONG[wrong](right)) is None


def test_a_difference_that_a_wrong_state_hides_is_found(tmp_path: Path) -> None:
    """The second half of a recording is what a gateway makes that has not seen all of the first."""
    config, entries = random_session(random.Random(7), 1_200)
    path = written(tmp_path / "a.mcap", config, entries)
    start_ns = planned(path, 2)[1].start_ns
    before = [each for each in entries if each.stamp_ns < start_ns]
    forgetful = Session(Gateway(config))
    for entry in before:
        if entry.kind.is_input and not (entry.kind is Kind.ROS_IN and entry.channel == "/a"):
            forgetful.recorded(entry)
    made, number = [], before[-1].seq
    for entry in entries[len(before) :]:
        if entry.kind.is_input:
            group = forgetful.recorded(replace(entry, seq=number + 1))
            made += [replace(entry, seq=number + 1), *group]
            number = made[-1].seq
    path = written(tmp_path / "b.mcap", config, [*before, *made])
    right = planned(path, 2)
    with SessionFile.open(path) as file:
        of_a = {each.stamp_ns for each in file.entries() if each.channel == "/a" and each.kind is Kind.ROS_IN}
    kept = tuple(replace(one, times=tuple(time for time in one.times if time not in of_a)) for one in right[1].state)
    wrong = [right[0], replace(right[1], state=kept)]
    one, two = results(path, wrong)
    whole = of_whole(path)
    assert isinstance(whole, Verification) and not whole.good
    assert one.good and two.good and one.last + 1 == two.first, "each alone is right: only the joint is not"
    assert one.after != two.before and joined(path, wrong) is None and joined(path, right) is None


def test_segments_without_a_joint_are_verified_as_one(tmp_path: Path) -> None:
    path = FIXTURES / "star.mcap"
    right = planned(path, 6)
    report = joined(path, [*right[:3], replace(right[3], state=()), *right[4:]])
    assert report and is_equal(report, of_whole(path))


def test_what_the_digest_does_not_know_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    path = FIXTURES / "star.mcap"
    with pytest.raises(NoDigest, match="_thread"):
        core = Gateway(Config())
        core._latest.entries["/a"] = __import__("threading").Lock()
        state_digest(core)
    monkeypatch.setattr(segments, "state_digest", lambda _core: (_ for _ in ()).throw(NoDigest("anything")))
    assert joined(path, planned(path)) is None


# -- the digest ----------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not COMPILES, reason="needs the compiled passage")
@table("seed", range(2), gate=lambda seed: seed < 1)
def test_the_state_after_compiled_conversions_is_that_of_the_full_path(seed: int, tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", *random_session(random.Random(seed), 800))
    with SessionFile.open(path) as file:
        config = config_to_run(file.session)
        full = Verifier(config, DeclaredLosses(), None)
        quick = Checker(Verifier(config, DeclaredLosses(), None, compiles=True), {})
        digests = []
        for columns in file.columns():
            for entry in columns.entries():
                full.take(entry)
            quick.take(columns)
            quick.collect()
            digests.append((state_digest(quick.verifier.core), state_digest(full.core)))
        quick.close()
    assert len({one for one, _ in digests}) == len(digests) > 2
    assert all(one == other for one, other in digests)


def _objects(core: object) -> list[object]:
    """All that a gateway holds, for the tests."""
    found: dict[int, object] = {}
    waiting: list[object] = [core]
    while waiting:
        each = waiting.pop()
        if id(each) in found or isinstance(each, (str, bytes, int, float, type)):
            continue
        found[id(each)] = each
        if isinstance(each, dict):
            waiting += each.values()
        elif isinstance(each, (list, tuple, set)):
            waiting += each
        elif type(each).__module__.startswith("igtl_gateway."):
            names = {*getattr(each, "__dict__", ()), *getattr(type(each), "__slots__", ())}
            waiting += [getattr(each, name) for name in names if hasattr(each, name)]
    return list(found.values())


def _disturb(core: Gateway, chance: random.Random) -> None:
    """Change all that the digest leaves out."""
    before = state_digest(core)
    for each in _objects(core):
        name = type(each).__name__
        if name == "Bookkeeper":
            each.ledger = Ledger()  # type: ignore[attr-defined]
        elif name == "Peer":
            each.sent += chance.randrange(1, 9)  # type: ignore[attr-defined]
        elif name == "GuardedStream":
            each.timing = StampTiming()  # type: ignore[attr-defined]
            each._stale_since_ns = chance.randrange(1 << 60)  # type: ignore[attr-defined]
            each.stale *= 3  # type: ignore[attr-defined]
            each._still += 9 * (each._still >= STILL_LOOKS)  # type: ignore[attr-defined]
            for episode in each.episodes.values():  # type: ignore[attr-defined]
                episode[0], episode[2] = 1, chance.randrange(1, 99)
        elif name == "Activity":
            each._refused *= 5  # type: ignore[attr-defined]
        elif isinstance(each, Denials):
            each._known.clear()
        elif isinstance(each, VolumeAssembler):
            each._state += 2
    assert state_digest(core) == before


@table("name", ["random", *LONG, "every-type", "crtk"])
def test_what_the_digest_leaves_out_decides_no_output(name: str) -> None:
    chance = random.Random(name)
    if name == "random":
        config, entries = random_session(chance, 1_500)
    else:
        with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
            config, entries = config_to_run(file.session), list(file.entries())
    core = Gateway(config, fast_path=False)
    again = Session(core)
    expected: list[Entry] = []
    for entry in entries:
        if entry.kind.is_input:
            if chance.random() < 0.05:
                _disturb(core, chance)
            expected += again.recorded(entry)
    outputs = [entry for entry in entries if not entry.kind.is_input]
    assert len(outputs) == len(expected)
    assert not any(compare(one, two, 0) for one, two in zip(outputs, expected, strict=True))


# -- processes -----------------------------------------------------------------------------------------------------

#: What a program does in place of the work of a segment, by the number of times that it was done.
_PROGRAM = """
import json, os, signal, sys, time
from pathlib import Path
from igtl_gateway.app import verification
from igtl_gateway.base.systems import forks
from igtl_gateway.cli import main
from igtl_gateway.replay import segments
segments.LEAST_ENTRIES = verification._ENTRIES_EACH = 20
kills, tally = int(sys.argv[2]), Path(sys.argv[3])
right = verification.verify_segment
def work(*values, **named):
    with tally.open("a") as file:
        file.write("x")
        file.flush()
    if tally.stat().st_size <= kills:
        os.kill(os.getpid(), signal.SIGKILL)
    return right(*values, **named)
verification.verify_segment = work
verification.usable_cpus = lambda: 2
import igtl_gateway.cli.verify_run as run
run.usable_cpus = lambda: 2
sys.exit(main(["verify", sys.argv[1], *sys.argv[4:]]))
"""


def verify_with_kills(path: Path, kills: int, tally: Path, *options: str) -> tuple[int, str, int]:
    """Exit code and output of a verification in two processes, of which some are killed; and how often one began."""
    words = [sys.executable, "-c", _PROGRAM, str(path), str(kills), str(tally), *options]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert not done.stderr, done.stderr
    return done.returncode, done.stdout, tally.stat().st_size if tally.exists() else 0


@pytest.mark.skipif(sys.platform != "linux", reason="segments are verified in processes on Linux")
@table("kills", [0, 1, 4, 10, 1_000])
def test_killed_processes_change_nothing(kills: int, tmp_path: Path) -> None:
    path = FIXTURES / "star.mcap"
    code, text, begun = verify_with_kills(path, kills, tmp_path / "tally", "--json")
    assert code == 0 and json.loads(json.dumps(judged(verify_recording(path)))) == json.loads(text) | {"compiled": 0}
    parts = len(planned(path, 8))
    assert begun == min(kills + parts, 3 * parts)


@pytest.mark.skipif(sys.platform != "linux", reason="segments are verified in processes on Linux")
@table("change", ["a bit of an output", "an input is missing", "links of an output"])
def test_the_first_difference_is_that_of_the_whole(
    change: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chance = random.Random(change)
    config, entries = random_session(chance)
    path = written(tmp_path / "a.mcap", config, CHANGES[change](entries, chance))
    code, text, begun = verify_with_kills(path, 0, tmp_path / "tally")
    assert begun > 1 and code == 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("igtl_gateway.cli.verify_run.usable_cpus", lambda: 1)
        from igtl_gateway.cli import main

        assert main(["verify", str(path)]) == 1
    assert capsys.readouterr().out == text


def test_without_memory_for_two_processes_there_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = FIXTURES / "star.mcap"
    monkeypatch.setattr(verification, "_ENTRIES_EACH", 20)
    begun: list[Any] = []

    def in_turn(work: Callable[[int], bytes], parts: int, most: int, _tick: object) -> list[bytes | None]:
        begun.append(most)
        return [work(part) for part in range(parts)]

    monkeypatch.setattr(verification, "in_processes", in_turn)
    monkeypatch.setattr(verification, "can_fork", lambda: True)
    monkeypatch.setattr(verification, "free_memory", lambda: 600 << 20)
    assert verify_recording(path, workers=8).good and begun == [2]
    monkeypatch.setattr(verification, "free_memory", lambda: 300 << 20)
    assert verify_recording(path, workers=8).good and begun == [2]
