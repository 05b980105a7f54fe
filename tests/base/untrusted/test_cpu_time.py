"""``--limit seconds`` bounds the CPU time of every verb, also inside of one message."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from igtl_gateway.addons.cohort.ends import FAILED
from igtl_gateway.addons.cohort.jobs import run_job
from igtl_gateway.base.clock import process_ns
from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted import cpu_time, files, limits
from igtl_gateway.cli import decode_run, main
from igtl_gateway.cli.verbs import available
from igtl_gateway.convert import clouds
from tests.costly import polydata_of_attributes
from tests.places import ROOT
from tests.script import Script
from tests.tables import table

#: Verb → its words, with {file} for a recording, {out} for a new one, {folder} for a new folder.
WORDS = {
    "verify": "{file}",
    "diff": "{file} {file}",
    "slice": "{file} -o {out} --end 0.5",
    "recover": "{file} -o {out}",
    "seal": "{file} --key {file} -o {out}",
    "mark": "{file} --label here --at 0.1",
    "info": "{file}",
    "doctor": "{file}",
    "lint": "{file}",
    "decode": "{file}",
    "sync": "{file} TRANSFORM/A",
    "merge": "{file} {file} -o {out}",
    "deidentify": "{file} -o {out}",
    "import": "{file} -o {out}",
    "export": "{file} --to csv -o {folder}",
    "view": "{file} -o {folder}.rrd",
    "review": "{file}",
}


def test_every_verb_that_reads_files_has_a_row() -> None:
    assert WORDS.keys() == {name for name, verb in available().items() if verb.is_bounded}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second of the limits has 50 ms."""
    monkeypatch.setattr(cpu_time, "_NS_PER_S", 50_000_000)


@pytest.mark.slow
@table("verb", sorted(WORDS))
def test_a_verb_ends_inside_of_an_endless_step(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    def endless(path: Path) -> int:
        while path:
            try:
                sum(range(100))
            except Exception:  # as that of a stage, which costs one message only
                continue
        return 0

    file = tmp_path / "a.mcap"
    shutil.copy(ROOT / "fixtures" / "paper-types.mcap", file)
    words = WORDS[verb].format(file=file, out=tmp_path / "out.mcap", folder=tmp_path / "out")
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(files, "size_of", endless)
    monkeypatch.setattr(decode_run, "_source", endless)
    code = main([verb, *words.split(), "--limit", "seconds=1"])
    told = capsys.readouterr()
    own = [line for line in told.err.splitlines() if "the new spelling" not in line]
    assert code in (1, 2) and len(own) == 1, told.err
    assert "1 s of work, expected at most 1 s (--limit seconds=1)" in told.err
    assert sorted(tmp_path.iterdir()) == before  # nothing half-made is left


def test_one_message_is_interrupted_too(monkeypatch: pytest.MonkeyPatch, quick: None) -> None:
    def endless(*_: object) -> None:
        while True:
            sum(range(100))

    script = Script()
    script.up(1)
    monkeypatch.setattr(clouds, "_cloud", endless)
    bound = limits.parse_limits(["seconds=1"])
    with (
        pytest.raises(LimitExceeded, match="expected at most 1 s"),
        limits.limits_in_force(bound),
        cpu_time.bounded(),
    ):
        script.igtl(polydata_of_attributes(3))


def test_a_file_gives_time_and_a_wait_costs_none(quick: None) -> None:
    with limits.limits_in_force(limits.parse_limits(["seconds=1"])), cpu_time.bounded():
        cpu_time.opened(Path("a"), 2_000_000)
        with cpu_time.not_counted():
            _work(100_000_000)
        _work(100_000_000)


def test_a_file_of_a_cohort_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None) -> None:
    monkeypatch.setattr(files, "size_of", lambda path: _work(1 << 62))
    job = {"name": str(tmp_path / "a"), "size": 1, "e_tag": "", "verb": "info", "settings": {}, "content": ""}
    reply = run_job(job | {"limits": ["seconds=1"]})
    assert reply["status"] == FAILED or "seconds=1" in reply["error"]
    assert "expected at most 1 s" in reply["error"]


def test_a_program_that_goes_on_is_ended(quick: None, monkeypatch: pytest.MonkeyPatch) -> None:
    class Ended(BaseException): ...

    def end(error: LimitExceeded) -> None:
        raise Ended(str(error))

    monkeypatch.setattr(cpu_time, "_AGAIN_NS", 10_000_000)
    monkeypatch.setattr(cpu_time, "_MOST", 2)
    swallowed = 0
    bound = limits.parse_limits(["seconds=1"])
    with pytest.raises(Ended, match="seconds=1"), limits.limits_in_force(bound), cpu_time.bounded(end):
        while True:
            try:
                _work(1 << 62)
            except KeyboardInterrupt:
                swallowed += 1
    assert swallowed == 2


def _work(ns: int) -> int:
    """Use CPU time, ns."""
    end_ns = process_ns() + ns
    while process_ns() < end_ns:
        pass
    return 0
