"""The generator of damaged imports: the same cases from the same seed, and good files among them."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import islice
from pathlib import Path
from random import Random

from igtl_gateway.addons.exchange.formats import open_source
from igtl_gateway.gateway.log.entry import Kind
from tools import slicer_mutations
from tools.import_mutations import BUILDERS, Bend, Case, cases


def test_a_seed_gives_the_same_cases() -> None:
    first, again, other = (list(islice(cases(seed), 30)) for seed in (1, 1, 2))
    assert first == again != other
    assert {case.name.split()[0] for case in first} == set(BUILDERS)


def test_what_is_not_bent_can_be_imported(tmp_path: Path) -> None:
    taken: Counter[str] = Counter()
    for seed in range(24):
        for name, build in BUILDERS.items():
            folder = tmp_path / f"{seed}-{name}"
            folder.mkdir()
            path = Case(name, build(Bend(Random(seed), 0.0))).write(folder)
            with closing(open_source(path)) as source:
                taken[name] += sum(1 for _ in source.items())
    assert all(taken[name] > 10 for name in BUILDERS)


def test_files_of_slicer_that_are_not_bent_can_be_imported(tmp_path: Path) -> None:
    first, again = (list(islice(slicer_mutations.cases(1), 30)) for _ in range(2))
    assert first == again
    for seed in range(6):
        for name, (suffix, build) in slicer_mutations.BUILDERS.items():
            path = tmp_path / f"{seed}-{name}{suffix}"
            path.write_bytes(build(Bend(Random(seed), 0.0)))
            with closing(open_source(path)) as source:
                assert sum(item.kind is Kind.IGTL_IN for item in source.items()) > 0, name
                assert not any(row.left_out for row in source.rows), name
