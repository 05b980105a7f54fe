"""Which peers are asked for their clock, and when: no sockets."""

from __future__ import annotations

from igtl_gateway.app.clock_asker import REPORT_NS, ClockAsker
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.dialogue.clocks import ASK_CLOCK, REPORT
from igtl_gateway.gateway.log.note import Note
from tests.gateway.dialogue.test_clocks import Asked


def test_once_a_minute_a_note_says_what_is_known_and_only_those_are_asked_that_answered() -> None:
    asked, found = Asked(), list[tuple[Note, int]]()
    asker = ClockAsker(["10.0.0.7:*"], asked.questions, lambda note, link: found.append((note, link)))
    for second in range(130):
        asker.look([asked.link, 9], second * NS_PER_S)
        asked.ask()
        if second < 125:
            asked.answer()
    assert len(found) == 126 and {link for _, link in found} == {asked.link}
    said = [second for second, (note, _) in enumerate(found) if note.data.get(REPORT)]
    assert said == [0, REPORT_NS // NS_PER_S, 2 * REPORT_NS // NS_PER_S]
    assert {note.code for note, _ in found} == {ASK_CLOCK}


def test_a_relay_asks_nobody_and_a_link_that_ends_is_forgotten() -> None:
    found: list[int] = []
    ClockAsker(["**"], None, lambda _note, link: found.append(link)).look([1], 0)
    asked = Asked()
    asker = ClockAsker(["**"], asked.questions, lambda _note, link: found.append(link))
    asker.look([asked.link], 0)
    asked.gateway.disconnect(asked.link)
    asker.look([], NS_PER_S)
    assert found == [asked.link] and not asker._reported
