"""Which peers are asked for their clock, and when: no sockets."""

from __future__ import annotations

from igtl_gateway.app.clock_asker import REPORT_NS, SILENT_NS, ClockAsker
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.dialogue.clocks import ASK_CLOCK, REPORT
from igtl_gateway.gateway.log.note import Note
from tests.gateway.dialogue.test_clocks import Asked

ADDRESS = "10.0.0.7:5"


def test_once_a_minute_a_note_reports_what_is_known_and_silence_has_one() -> None:
    asked, found = Asked(), list[tuple[Note, int]]()
    asker = ClockAsker((ADDRESS,), asked.questions, lambda note, link: found.append((note, link)))
    for second in range(160):
        asker.look({asked.link: ADDRESS, 9: "10.0.0.9:5"}, second * NS_PER_S)
        if second < 126:
            asked.ask()
        if second < 125:
            asked.answer()
    *asking, (silence, _) = found
    assert len(asking) == 126 and {link for _, link in found} == {asked.link}
    reported = [second for second, (note, _) in enumerate(asking) if note.data.get(REPORT)]
    assert reported == [0, REPORT_NS // NS_PER_S, 2 * REPORT_NS // NS_PER_S]
    assert {note.code for note, _ in asking} == {ASK_CLOCK}
    assert silence.code == "peer_no_clock" and silence.text.startswith(f"{ADDRESS}: no answer for 10 s to the question")
    assert SILENT_NS == 10 * NS_PER_S


def test_a_relay_asks_no_peer_and_a_link_that_ends_is_forgotten() -> None:
    found: list[int] = []
    ClockAsker(("**",), None, lambda _note, link: found.append(link)).look({1: ADDRESS}, 0)
    asked = Asked()
    asker = ClockAsker(("**",), asked.questions, lambda _note, link: found.append(link))
    asker.look({asked.link: ADDRESS}, 0)
    asked.gateway.disconnect(asked.link)
    asker.look({}, NS_PER_S)
    assert found == [asked.link] and not asker._reported and not asker._asked
