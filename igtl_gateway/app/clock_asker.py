"""Decides which peers are asked for their clock, and when: once a second, if the last question has its answer."""

from __future__ import annotations

from collections.abc import Callable, Collection

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.dialogue.clocks import ClockQuestions, ask_note
from igtl_gateway.gateway.log.note import Note

#: Between two notes of what is known of a clock; the recording has each answer.
REPORT_NS = 60 * NS_PER_S


class ClockAsker:
    """Submits the notes that have peers asked.

    Args:
        globs: addresses of the peers; one that asks is asked, too.
        questions: knows who waits; None: a relay, which asks no peer.
        note: submits a note of a link.
    """

    def __init__(
        self, globs: Collection[str], questions: ClockQuestions | None, note: Callable[[Note, int], None]
    ) -> None:
        self._globs = globs
        self._questions = questions
        self._note = note
        self._reported: dict[int, int] = {}  # link → when its last note was asked for, monotonic ns

    def look(self, links: Collection[int], now_ns: int) -> None:
        """Ask those that are due.

        Args:
            links: numbers of the open links.
            now_ns: monotonic time.
        """
        if self._questions is None:
            return
        self._reported = {link: at_ns for link, at_ns in self._reported.items() if link in links}
        for link in links:
            if self._questions.may_ask(link, self._globs):
                report = now_ns - self._reported.get(link, now_ns - REPORT_NS) >= REPORT_NS
                if report:
                    self._reported[link] = now_ns
                self._note(ask_note(report=report), link)
