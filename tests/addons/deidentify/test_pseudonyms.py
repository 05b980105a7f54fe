"""New names: by parts, of any text and any length."""

from __future__ import annotations

import pytest

from igtl_gateway.addons.deidentify.pseudonyms import Pseudonyms
from tests.tables import table

KEY = b"0123456789abcdef"


def names(**given: object) -> Pseudonyms:
    return Pseudonyms(KEY, **given)  # type: ignore[arg-type]


def test_a_name_of_several_frames_is_replaced_part_by_part() -> None:
    new = names()
    probe, tracker, base = (new.name(each) for each in ("Probe", "Tracker", "Base"))
    assert new.name("ProbeToTracker") == f"{probe}To{tracker}"
    assert new.name("ProbeToTrackerToBase") == f"{probe}To{tracker}To{base}"
    # not a name of two: nothing before, nothing after, no capital, another character
    for whole in ("ToTracker", "ProbeTo", "Probetotracker", "ProbeTotracker", "ProbeToTracker-1", "Probe To Tracker"):
        assert "To" not in new.name(whole)[1:]
    # the first place decides, behind the first character
    assert new.name("ToAToB") == f"{new.name('ToA')}To{new.name('B')}"


def test_given_and_kept_names_are_parts_too() -> None:
    new = names(given={"Tracker": "polaris", "BaseToWorld": "fixed"}, kept=("Probe*",))
    assert new.name("XToTracker") == f"{new.name('X')}ToPolaris"
    assert new.name("ProbeToTracker") == "ProbeToTracker"  # the glob matches all of it
    assert new.name("XToBaseToWorld") == f"{new.name('X')}ToFixed"


@pytest.mark.parametrize("name", ["A" + "ToB" * 20, "A" + "ToB" * 84])
def test_many_parts(name: str) -> None:
    new = names()
    first, part = new.name("A"), new.name("B")
    assert new.name(name) == "To".join([first] + [part] * name.count("To"))


@table("end", ["", "-", "To"])
@table("repeats", [85, 5_000, 150_000])
def test_a_name_that_no_frame_has_is_replaced_as_a_whole(repeats: int, end: str) -> None:
    new = names(kept=("Probe*",))
    found = new.name("A" + "ToB" * repeats + end)
    assert len(found) == 8
    assert new.name("A" + "ToB" * (repeats + 1) + end) != found


def test_any_text_has_a_pseudonym() -> None:
    new = names()
    texts = ["\ud800", "a\ud800b", "\udc80", "\ud800\udc80", "\x00", "ä", "\U0001f600"]
    assert len({new.name(text) for text in texts}) == len(texts)
    assert {new.identifier("\ud800"), new.address("\ud800")}.isdisjoint(texts)
