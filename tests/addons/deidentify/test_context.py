"""What the rules share: text, and names in the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from igtl_gateway.addons.deidentify.context import Context
from igtl_gateway.addons.deidentify.profile import BASIC, Profile, TextRule
from igtl_gateway.addons.deidentify.session import deidentify
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tests.addons.deidentify.planted import SOURCE
from tests.tables import table

KEY = bytes(range(32))


def context_of(profile: Profile) -> Context:
    return Context.of(profile, KEY, 0)


@table("stream", ["STRING/Qx7", "/qx7/kmv", "STRING/AToB"])
def test_a_text_that_stays_replaces_no_name(stream: str) -> None:
    context = context_of(replace(BASIC, text_rules=(TextRule("**", "keep"),)))
    assert context.text("words", stream) == "words"
    assert context.report.rules["name"] == 0
    assert context.report.left == {f"text of {context.stream_name(stream)}": "the profile keeps it"}
    assert context.report.rules["name"] == sum(part != "" for part in stream.split("/")) - stream.startswith("STRING")


def test_a_text_that_changes_is_counted_and_an_empty_one_is_not() -> None:
    context = context_of(BASIC)
    assert (context.text("words", "STRING/Qx7"), context.text("", "STRING/Qx7")) == ("", "")
    assert (context.report.rules["text"], context.report.left) == (1, {})
    assert context.asked.streams == {"STRING/Qx7"}


def test_a_message_that_is_removed_replaces_no_name(tmp_path: Path) -> None:
    """The name of its stream is in the report only."""
    with SessionFile.open(SOURCE) as file:
        session, entries = dict(file.session), list(file.entries())
    (first, *_) = (entry for entry in entries if entry.kind.name == "ROS_IN")
    counted = []
    for name, number in (("one", 1), ("three", 3)):
        path = tmp_path / f"{name}.mcap"
        writer = SessionWriter(path, session)
        for seq in range(1, number + 1):
            writer.write(replace(first, seq=seq, stamp_ns=first.stamp_ns + seq, type="foreign_msgs/msg/Unknown"))
        writer.close({})
        report = deidentify(path, tmp_path / f"{name}-clean.mcap", BASIC, KEY)
        assert sum(report.removed.values()) == number
        counted.append(report.rules["name"])
    assert counted[0] == counted[1]
