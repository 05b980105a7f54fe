"""The generator of damaged imports: the same cases from the same seed, and good files among them."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from itertools import islice
from pathlib import Path
from random import Random

from igtl_gateway.addons.exchange.formats import open_source
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
