"""Mutants of MCAP files (``tools/mcap_mutations.py``) through the readers: entries, or one clear line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.replay import latched
from tests.files import write_anew
from tools import mcap_build, mcap_mutations

#: Mutants of each run, and of those how many go through the verbs, too.
CASES, THROUGH_VERBS = 150, 20


def _entries(path: Path) -> None:
    with SessionFile.open(path) as file:
        for _ in file.entries():
            pass


def _some_entries(path: Path) -> None:
    with SessionFile.open(path) as file:
        for _ in file.entries_of_kinds({Kind.LINK, Kind.EDGE_NOTE}):
            pass
        file.prologue()


def _entries_from_the_middle(path: Path) -> None:
    with SessionFile.open(path) as file:
        rule = latched.latched_state_rule(lambda topic, _type: "a" in topic)
        for _ in file.entries_with_state((file.start_ns + file.end_ns) // 2, rule):
            pass


def _salvage(path: Path) -> None:
    with Salvage.open(path) as file:
        for each in (file.read(), file.attachments(), file.metadata()):
            for _ in each:
                pass


READERS: tuple[Callable[[Path], None], ...] = (_entries, _some_entries, _entries_from_the_middle, _salvage)


def test_the_files_that_mutants_are_made_of_are_sound(tmp_path: Path) -> None:
    for name, parts in mcap_mutations.bases():
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(mcap_build.assemble(parts).finish())
        for reader in READERS:
            reader(path)
        with Salvage.open(path) as file:
            assert list(file.read()) and file.report.whole


def test_the_sequence_of_mutants_depends_on_the_seed_only() -> None:
    first, again, other = (list(islice(mcap_mutations.cases(seed), 5)) for seed in (3, 3, 4))
    assert first == again != other


@pytest.mark.slow
def test_readers_survive_mutants(tmp_path: Path) -> None:
    outcomes: Counter[str] = Counter()
    for name, data in islice(mcap_mutations.cases(14), CASES):
        write_anew(tmp_path / "a.mcap", data)
        for reader in READERS:
            try:
                reader(tmp_path / "a.mcap")
                outcomes["read"] += 1
            except GatewayError as error:
                assert "\n" not in str(error), name
                outcomes[type(error).__name__] += 1
    assert min(outcomes["read"], outcomes["DamagedRecording"]) > CASES // 2  # neither all refused nor all harmless


@pytest.mark.slow
def test_verbs_survive_mutants(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "a.mcap", str(tmp_path / "out.mcap")
    for name, data in islice(mcap_mutations.cases(15), THROUGH_VERBS):
        write_anew(path, data)
        for words in (
            ["info", str(path)], ["info", str(path), "--json"], ["verify", str(path)], ["doctor", str(path)],
            ["slice", str(path), "-o", out, "--overwrite"], ["diff", str(path), str(path)],
            ["recover", str(path), "--overwrite"], ["import", str(path), "-o", out, "--overwrite"],
        ):  # fmt: skip
            assert main(words) in (0, 1, 2), (name, words)
            said = capsys.readouterr()
            unsafe = {char for char in said.out + said.err if ord(char) < 32 and char != "\n"}
            assert not unsafe, (name, words)
