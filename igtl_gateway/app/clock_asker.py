"""Decides which peers are asked for their clock, and when: once a second, if the last question has its answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from igtl_gateway.base.quantities import duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions, ask_note, no_answer_note
from igtl_gateway.gateway.log.note import Note

#: Between two notes of what is known of a clock; the recording has each answer.
REPORT_NS = 60 * NS_PER_S
#: A question without an answer for this time has a note; the peer is not asked again.
SILENT_NS = 10 * NS_PER_S


class ClockAsker:
    """Submits the notes that have peers asked.

    Args:
        globs: addresses of the peers; one that asks is asked, too.
        questions: knows who waits; None: a relay, which asks no peer.
        note: submits a note of a link.
    """

    def __init__(
        self, globs: tuple[str, ...], questions: ClockQuestions | None, note: Callable[[Note, int], None]
    ) -> None:
        self._globs = globs
        self._questions = questions
        self._note = note
        self._reported: dict[int, int] = {}  # link → when its last note was asked for, monotonic ns
        self._asked: dict[int, int] = {}  # link → when it was asked, if it has not been silent

    def look(self, links: Mapping[int, str], now_ns: int) -> None:
        """Ask those that are due.

        Args:
            links: number → address of the open links.
            now_ns: monotonic time.
        """
        if self._questions is None:
            return
        for known in (self._reported, self._asked):
            for link in known.keys() - links.keys():
                del known[link]
        for link, address in links.items():
            if self._questions.may_ask(link, self._globs):
                report = now_ns - self._reported.get(link, now_ns - REPORT_NS) >= REPORT_NS
                if report:
                    self._reported[link] = now_ns
                self._asked[link] = now_ns
                self._note(ask_note(report=report), link)
            elif now_ns - self._asked.get(link, now_ns) >= SILENT_NS and self._questions.clocks.waits(link):
                del self._asked[link]
                self._note(no_answer_note(address, duration_text(SILENT_NS)), link)
