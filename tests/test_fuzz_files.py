"""``tools/fuzz_files.py``: a short part of every run, and that it would notice."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.cli import main
from tools import fuzz_files
from tools.fuzz_files import READERS, Broken, Fuzzer, Reader, run, verb
from tools.import_mutations import Case

#: Cases of each reader in every run of the tests.
CASES = {"mcap": 100, "import": 200, "image": 300, "slicer": 300, "configuration": 500}


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_the_readers_stand(reader: str) -> None:
    report = run(0, lambda done: done < CASES[reader], (reader,))[reader]
    assert report.broken == {}
    assert report.cases == CASES[reader]
    # much of it is refused, and some of it is read
    assert len(report.outcomes) >= 2
    assert any(outcome.startswith(("read", "saved", "info")) for outcome in report.outcomes)


def test_the_seed_decides() -> None:
    one, again, other = (run(seed, lambda done: done < 100, ("image",))["image"].outcomes for seed in (1, 1, 2))
    assert one == again != other


def found(folder: Path, read: Callable[[Path, Random], str]) -> list[str]:
    """What is found wrong with a reader of one file."""

    def cases(_seed: int) -> Iterator[Case]:
        while True:
            yield Case("good", {"a.mha": b"ObjectType = Image"})

    fuzzer = Fuzzer(Reader(cases, read), 0, folder / "broken")
    fuzzer.batch(folder, 3)
    return [key.partition(" ")[0] for key in fuzzer.report.broken]


def test_what_escapes_a_reader_is_found(tmp_path: Path) -> None:
    def crashes(path: Path, _rng: Random) -> str:
        raise IndexError(path)

    def refuses(path: Path, _rng: Random) -> str:
        raise DamagedRecording(str(path))

    assert found(tmp_path, refuses) == []
    assert not (tmp_path / "broken").exists()
    assert found(tmp_path, crashes) == ["IndexError"]
    (culprit,) = (tmp_path / "broken").iterdir()
    assert (culprit / "a.mha").read_bytes() == b"ObjectType = Image"
    assert "IndexError" in (culprit / "WHY.txt").read_text()


def test_what_takes_too_much_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_files, "CPU_S", -1.0)
    assert found(tmp_path, lambda _path, _rng: "read") == ["slow"]
    monkeypatch.setattr(fuzz_files, "CPU_S", 60.0)
    monkeypatch.setattr(fuzz_files, "GROWTH_MB", -1)
    assert found(tmp_path, lambda _path, _rng: "read") == ["memory"]


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the system does not reset the peak")
def test_what_others_take_is_not_of_a_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader was blamed for the libraries that others load, and for the 300 MB that it took to make a nested case."""

    def cases(_seed: int) -> Iterator[Case]:
        yield Case("case", {"a": bytes((bytearray(b"1") * (90 << 20))[:1])})

    monkeypatch.setattr(fuzz_files, "GROWTH_MB", 30)
    fuzzer = Fuzzer(Reader(cases, lambda _path, _rng: "read"), 0, None)
    kept = bytearray(b"1") * (90 << 20)
    fuzzer.batch(tmp_path, 1)
    assert kept and not fuzzer.report.broken


def test_what_is_printed_raw_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert verb(tmp_path / "a\x1b\n", "info F") == f"info {main(['info', str(tmp_path / 'none')])}"

    def prints(arguments: list[str]) -> int:
        sys.stdout.write(arguments[1])
        return 0

    monkeypatch.setattr(fuzz_files, "command_line", prints)
    with pytest.raises(Broken, match="printed"):
        verb(tmp_path / "a\x1b", "info F")
