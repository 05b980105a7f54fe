"""``tools/fuzz_values.py``: kinds follow from the grammar, cases from their names; a slice of them in every run."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from random import Random

import pytest

from igtl_gateway.base.errors import GatewayError
from tests.tables import table
from tools import fuzz_values
from tools.fuzz_files import Reader, run
from tools.fuzz_values import FORMATS, case_of, cases, kinds, readers
from tools.import_mutations import Case
from tools.kinds.values import CHOICES, LONG, Maker

#: Cases of each format in every run of the tests.
CASES = 25
#: Cases that broke a reader or a verb when they were found: read by all verbs of their format again.
FOUND = (
    "session/config.to_igtl[].metadata=1e308/1000213",
    "session/qos.depth=digits/1",
    "pcapng/interface.if_tsresol=none/3",
    "lerobot/form.v2.1.meta/episodes_stats.jsonl.(key)=forged/201001856",
    "rosbag1/type.lab/Empties.data@0=u32 ones</1",
    "rosbag1/type.lab/Stamped.data@28=u32 ones</2",
)


@pytest.mark.slow
@table("form", FORMATS)
def test_the_readers_stand(form: str) -> None:
    report = run(1, lambda done: not done, (form,), None, known=readers(0), size=CASES)[form]
    assert report.broken == {}
    assert report.cases == CASES


@table("form", FORMATS)
def test_a_file_without_a_wrong_value_is_read(form: str, tmp_path: Path) -> None:
    """The wrong value is what a reader meets, not a mistake of the builder."""
    for seed in range(2):
        folder = tmp_path / str(seed)
        folder.mkdir()
        path = Case(form, FORMATS[form].make(Maker(seed))).write(folder)
        assert FORMATS[form].read(path, Random(seed)).startswith("read")


@pytest.mark.slow
@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_stays_mended(name: str) -> None:
    for report in fuzz_values.one(name, None).values():
        assert report.broken == {} and report.cases == 1


def test_a_case_is_made_again_from_its_name() -> None:
    for form in ("rosbag1", "nrrd", "configuration"):
        for one, again in zip(islice(cases(form, 5), 20), islice(cases(form, 5), 20), strict=True):
            assert one == again == case_of(one.name)
        others = [case.name for case in islice(cases(form, 6), 20)]
        assert others != [case.name for case in islice(cases(form, 5), 20)]


def test_each_kind_is_struck_once_before_one_is_struck_again() -> None:
    known = kinds("profile")
    struck = [case.name.partition("/")[2].rpartition("/")[0] for case in islice(cases("profile", 3), 2 * len(known))]
    assert sorted(struck[: len(known)]) == sorted(struck[len(known) :]) == sorted(known)
    assert struck[: len(known)] != struck[len(known) :]


def test_the_kind_is_in_the_file() -> None:
    """The only difference between a case and the same seed without a wrong value is that value."""
    (data,) = case_of("profile/mask.value=digits/4").files.values()
    (true,) = FORMATS["profile"].make(Maker(4)).values()
    assert data.decode() == true.decode().replace("value = 0", f"value = {LONG}")
    assert CHOICES["float"].keys() >= {"nan", "inf", "1e308"}
    # every format has thousands of kinds, of every type that it can store
    assert all(len(kinds(form)) > 500 for form in FORMATS)


def test_variants_follow_from_the_kind() -> None:
    """A field that only one variant has is struck in that variant, whatever the seed is."""
    name = next(each for each in kinds("pcapng") if each.startswith("packet.obsolete."))
    for seed in range(3):
        maker = Maker(seed, name)
        FORMATS["pcapng"].make(maker)
        assert name.rpartition("=")[0] in maker.fields


def test_what_breaks_a_reader_is_found_by_its_name(tmp_path: Path) -> None:
    def crashes(path: Path, _rng: Random) -> str:
        if LONG.encode() in path.read_bytes():
            raise ValueError("digits")
        raise GatewayError("refused")

    known = {"profile": Reader(lambda _seed: iter([case_of("profile/mask.value=digits/4")]), crashes)}
    report = run(0, lambda done: not done, ("profile",), tmp_path / "broken", known=known, size=1)["profile"]
    assert [key.partition(" ")[0] for key in report.broken] == ["ValueError"]
    (culprit,) = (tmp_path / "broken").iterdir()
    assert (culprit / "WHY.txt").read_text().startswith("profile/mask.value=digits/4\n")
