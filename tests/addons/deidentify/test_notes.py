"""The rules for notes and marks by tables: what of a note stays, and what of it goes."""

from __future__ import annotations

from typing import Any

from igtl_gateway.addons.deidentify.context import Context
from igtl_gateway.addons.deidentify.notes import CODES, OTHER, clean_mark, clean_note, known_kinds, known_types
from igtl_gateway.addons.deidentify.profile import BASIC, Profile, TextRule
from igtl_gateway.gateway.log.clock_offset import DEVICE
from igtl_gateway.gateway.log.marks import Mark, MarkNote
from igtl_gateway.gateway.log.note import Level, Note
from tests.tables import table

SECOND, NAME = 1_000_000_000, "Qx7Kmvz3"
KEY, SHIFT_NS, DATE_NS = bytes(range(32)), -864_000 * SECOND, 1_600_000_000 * SECOND


def context_of(profile: Profile = BASIC) -> Context:
    return Context.of(profile, KEY, SHIFT_NS)


def cleaned(data: dict[str, Any], code: str = "link_up", text: str = "", stream: str = "") -> tuple[Note, Context]:
    context = context_of()
    return Note.of(clean_note(Note(Level.WARN, code, text, stream, data).pack(), context)), context


def address(text: str, prefix: str) -> str:
    return context_of().names.address(text, prefix)


#: Facts of a note → what stays of them.
FACTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "peer": ({"peer": f"{NAME}:18944"}, {"peer": address(f"{NAME}:18944", "peer")}),
    "host": ({"local": f"{NAME}:18944"}, {"local": address(f"{NAME}:18944", "host")}),
    "role": ({"role": "client"}, {"role": "client"}),
    "any role": ({"role": NAME}, {}),
    "numbers": (
        dict.fromkeys("partner sent_messages received_bytes count step_ns jump_ns ahead_ns".split(), -7)
        | {"dropped_messages": 9.5, "dropped": 11},
        dict.fromkeys("partner sent_messages received_bytes count step_ns jump_ns ahead_ns".split(), -7)
        | {"dropped_messages": 9.5, "dropped": 11},
    ),
    "numbers of another kind": ({"dropped_messages": True, "dropped": {NAME: 3}, "partner": [3]}, {}),
    "other facts": ({"reason": NAME, "who": NAME, NAME: {NAME: 1}, "path": NAME}, {}),
    "a question for a clock": ({"report": True}, {"report": True}),
    "a report of another kind": ({"report": NAME}, {}),
    "device": ({"device": NAME}, {"device": context_of().names.name(NAME)}),
    "orders": (
        {"orders": {"0": ["command_late", f"{NAME} 0.5 s"], "12": [NAME, NAME], NAME: ["command_late", ""], "1": NAME,
                    "2": [], "3": [5]}},
        {"orders": {"0": ["command_late", "command late"], "12": ["other", "other"], "1": ["other", "other"],
                    "2": ["other", "other"], "3": ["other", "other"]}},
    ),
    "orders in a list": ({"orders": [NAME]}, {}),
    "settings": (
        {"settings": {"deny_in": ["IMAGE", NAME, "*", 5], "deny_out": ["**", f"{NAME}*"], "max_age_s": 0.5,
                      "active": True, "operator": NAME}},
        {"settings": {"deny_in": ["IMAGE", "*"], "deny_out": ["**"], "max_age_s": 0.5, "active": True}},
    ),
    "settings of another kind": (
        {"settings": {"deny_in": NAME, "kinds": NAME, "max_age_s": NAME, "active": [True]}}, {"settings": {}}
    ),
    "kinds": ({"settings": {"kinds": ["+pose", "transform", NAME]}}, {"settings": {"kinds": ["+pose", "transform"]}}),
}  # fmt: skip


@table("name", FACTS)
def test_what_stays_of_the_facts_of_a_note(name: str) -> None:
    given, expected = FACTS[name]
    new, context = cleaned(given)
    assert new.data == expected
    assert context.report.rules["address"] == sum(key in ("peer", "local") for key in expected)
    assert context.report.rules["note"] == len(given.keys() - expected.keys()) + 1, "its text, too"


@table(
    "data", [{"peer": [NAME]}, {"local": {NAME: 1}}, {"count": NAME}, {"step_ns": True}, {"dropped": NAME}, {"role": 5}]
)
def test_a_note_whose_facts_are_of_another_kind_loses_all_of_them(data: dict[str, Any]) -> None:
    new, _ = cleaned(data)
    assert (new.code, new.text, new.data) == (OTHER, OTHER, {})


@table("code", sorted({*CODES, NAME, OTHER}))
def test_the_text_of_a_note_is_its_code(code: str) -> None:
    new, _ = cleaned({}, code, f"about {NAME}")
    assert new.code == (code if code in CODES else OTHER)
    assert new.text == new.code.replace("_", " ") and new.level is Level.WARN


def test_a_note_that_has_nothing_of_a_person_is_no_change() -> None:
    assert cleaned({"count": 1}, "link_up", "link up")[1].report.rules["note"] == 0
    assert cleaned({"count": 1}, NAME, "other")[1].report.rules["note"] == 1


#: Stream of a note → its new stream.
STREAMS = {
    "": "",
    f"STRING/{NAME}": f"STRING/{context_of().names.name(NAME)}",
    f"/arm/{NAME}": f"/{context_of().names.name('arm')}/{context_of().names.name(NAME)}",
    f"{NAME}/{NAME}": "",  # no type of OpenIGTLink: it may be any text
}


@table("stream", STREAMS)
def test_the_stream_of_a_note_has_its_new_name(stream: str) -> None:
    assert cleaned({}, stream=stream)[0].stream == STREAMS[stream]


def test_a_mark_has_pseudonyms_moved_times_and_the_text_that_the_profile_leaves() -> None:
    mark = Mark("needle", f"{NAME} did so", NAME, DATE_NS, DATE_NS + 5)
    label, who = (context_of().names.name(each) for each in ("needle", NAME))
    assert clean_mark(mark, context_of()) == Mark(label, "", who, DATE_NS + SHIFT_NS, DATE_NS + SHIFT_NS + 5)
    kept = Profile(keep_names=("needle",), text_rules=(TextRule("mark/needle", "replace", "so"),))
    open_mark = Mark("needle", "x", "", DATE_NS, None)
    assert clean_mark(open_mark, context_of(kept)) == Mark("needle", "so", "", DATE_NS + SHIFT_NS, None)


def test_names_of_a_mark_have_a_bound_and_its_text_has_no_line_breaks() -> None:
    profile = Profile(keep_names=("**",), text_rules=(TextRule("**", "replace", "two\nlines"),))
    note = MarkNote("l" * 64, "x", "w" * 64).note()
    new = MarkNote.of(Note.of(clean_note(note.pack(), context_of(profile))))
    assert new is not None and (new.label, new.text, new.who) == ("l" * 64, "", "w" * 64)


def test_the_device_of_questions_for_a_clock_stays() -> None:
    assert context_of().names.name(DEVICE) == DEVICE


def test_types_and_kinds_that_nobody_made_up_stay() -> None:
    assert known_types(["IMAGE", "?*", "", "IMAG*", NAME, None]) == ["IMAGE", "?*", ""]
    assert known_kinds(["transform", "+transform", NAME, 5], context_of()) == ["transform", "+transform"]
