"""A verification by compiled conversions has the result of the full path, whatever is changed in a recording."""

from __future__ import annotations

import random
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.cli import main
from igtl_gateway.convert.units import UNITS
from igtl_gateway.gateway import Session, make_core
from igtl_gateway.gateway.fastpath.compiled_to_igtl import CompiledToIgtl
from igtl_gateway.gateway.fastpath.compiled_to_ros import CompiledToRos
from igtl_gateway.native.passage import is_compiled
from igtl_gateway.record.sessionfile import columns
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay.recheck import EVERY, Checker, is_sampled
from igtl_gateway.replay.recorded_config import config_to_run
from igtl_gateway.replay.verify import DeclaredLosses, Verifier
from igtl_gateway_lab.simulate.catalogue import SCENARIOS
from tests.places import FIXTURES
from tests.tables import table
from tools.recheck import CHANGES, FEW_CHANGES, both, judged, random_session, written

pytestmark = pytest.mark.skipif(not is_compiled(), reason="needs the compiled passage")


@table("path", sorted(FIXTURES.glob("*.mcap")), ids=lambda path: str(path.stem))
def test_a_fixture_has_the_same_result(path: Path) -> None:
    quick, reference = both(path)
    assert judged(quick) == judged(reference)
    assert quick.inputs >= quick.compiled and not reference.compiled


@table("seed", range(4), gate=lambda seed: seed < 2)
def test_a_random_session_has_the_same_result_and_ledger(seed: int, tmp_path: Path) -> None:
    config, entries = random_session(random.Random(seed))
    path = written(tmp_path / "a.mcap", config, entries)
    quick, reference = both(path)
    assert judged(quick) == judged(reference) and quick.good
    assert quick.compiled > quick.inputs // 3
    core = make_core(config, fast_path=False)
    session = Session(core)
    for entry in entries:
        if entry.kind.is_input:
            session.recorded(entry)
    with SessionFile.open(path) as file:
        checker = Checker(Verifier(config_to_run(file.session, None), DeclaredLosses(), None, compiles=True), {})
        for some in file.columns():
            checker.take(some)
        checker.collect()
        assert checker.verifier.core.ledger.to_dict() == core.ledger.to_dict()
        checker.close()


@table("change", sorted(CHANGES), gate=lambda change: change in FEW_CHANGES)
@table("seed", range(1))
def test_a_change_in_the_recording_is_found_with_the_same_words(change: str, seed: int, tmp_path: Path) -> None:
    chance = random.Random(f"{change} {seed}")
    config, entries = random_session(chance)
    changed = CHANGES[change](entries, chance)
    quick, reference = both(written(tmp_path / "a.mcap", config, changed))
    assert judged(quick) == judged(reference)


@table("change", ["", "link of an input", "links of an output"])
@table("seed", range(2), gate=lambda seed: seed < 1)
def test_heads_that_are_numbered_again_are_not_mixed_up(
    change: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file with many heads: those of the chunks before are forgotten, and their numbers stand for others."""
    monkeypatch.setattr(columns, "_LEARNED_HEADS", 1)
    chance = random.Random(f"{change} {seed}")
    config, entries = random_session(chance)
    changed = CHANGES[change](entries, chance) if change else entries
    quick, reference = both(written(tmp_path / "a.mcap", config, changed, chunk_bytes=2_000))
    assert judged(quick) == judged(reference)
    assert change or quick.compiled > quick.inputs // 3


def test_a_change_in_the_code_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = SCENARIOS["paper-types"]
    path = written(tmp_path / "a.mcap", scenario.config, list(scenario.entries()))
    monkeypatch.setitem(UNITS, "mm", 999)
    quick, reference = both(path)
    assert judged(quick) == judged(reference) and not quick.good


@table("own", [CompiledToRos, CompiledToIgtl], ids=["to ROS", "to OpenIGTLink"])
def test_a_wrong_compiled_conversion_is_found_in_what_it_has_recorded(
    own: type, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It agrees with itself; the sample has the last input of each channel."""
    right = own.__init__  # type: ignore[misc]
    names = list(signature(right).parameters)

    def wrong(self: Any, *values: Any, **named: Any) -> None:
        given = dict(zip(names, (self, *values), strict=False)) | named
        times, by = given["ratio"]
        right(**given | {"ratio": (times * 1.001, by)})

    monkeypatch.setattr(own, "__init__", wrong)
    config, entries = random_session(random.Random(1))
    quick, reference = both(written(tmp_path / "a.mcap", config, entries))
    assert judged(quick) == judged(reference) and not quick.good


def test_the_sample_does_not_follow_a_pattern_of_numbers() -> None:
    numbers = np.arange(1, 1 << 16, dtype=np.int64)
    for step in (2, 3, 4, EVERY):
        for first in range(step):
            some = is_sampled(numbers[first::step])
            assert 0.5 < some.mean() * EVERY < 2.0


def test_the_option_reference_computes_all_by_the_full_path(capsys: pytest.CaptureFixture[str]) -> None:
    path = str(FIXTURES / "star.mcap")
    assert main(["verify", path]) == 0
    assert "by compiled conversions" in capsys.readouterr().out
    assert main(["verify", path, "--reference"]) == 0
    assert "by compiled conversions" not in capsys.readouterr().out


def test_foreign_columns_and_messages_are_only_compared(tmp_path: Path) -> None:
    """Places outside, numbers and times at their limits, bytes that changed: nothing is read that is not there."""
    chance = random.Random(5)
    config, entries = random_session(chance, 900)
    path = written(tmp_path / "a.mcap", config, entries, chunk_bytes=8_000)
    limits = (0, 1, -1, 57, 1 << 31, (1 << 63) - 1, -(1 << 63))
    with SessionFile.open(path) as file:
        checker = Checker(Verifier(config_to_run(file.session, None), DeclaredLosses(), None, compiles=True), {})
        compared = 0
        for some in file.columns():
            checker.take(some)
            rows = checker._rows(some)
            assert rows
            for _ in range(60):
                data, *changed = bytearray(rows[0]), *(np.array(column) for column in rows[1:])
                for _ in range(chance.randrange(4)):
                    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
                for _ in range(chance.randrange(4)):
                    column = chance.choice(changed)
                    least, most = np.iinfo(column.dtype).min, np.iinfo(column.dtype).max
                    value = chance.choice((*limits, len(data), len(some), int(column[0])))
                    column[chance.randrange(len(column))] = min(max(value, least), most)
                changed[-1][:] = 0
                start, number = chance.randrange(len(some) + 2), int(rows[2][0]) - 1
                last = chance.choice((number, number + start, *limits))
                columns_of: Any = (bytes(data), *changed)
                row, why, inputs, _ = checker._passage.recheck(columns_of, checker._names.sources, start, last)
                assert row >= start and 0 <= why <= 6 and 0 <= inputs <= len(some)
                compared += inputs
        checker.close()
    assert compared
