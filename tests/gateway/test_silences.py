"""Silent streams: one note when a periodic stream pauses, one when it is back."""

from __future__ import annotations

from collections import Counter

from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.gateway.guarded_stream import GuardedStream
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.silences import STREAM_BACK, STREAM_SILENT, Silences

_T0 = 1_700_000_000 * NS_PER_S


class Streams:
    """Streams of one link, looked at once a second."""

    def __init__(self, *names: str) -> None:
        self.streams = {(1, name): GuardedStream(name, 0, watch=True) for name in names}
        self.silences = Silences()
        self.received: Counter[str] = Counter()
        self.second = 0

    def pass_s(self, seconds: int, *sending: str, unseen: str = "") -> list[tuple[int, Level, str, str]]:
        """Return second, level, code and text of the notes; ``unseen``: a stream of which the guard sees nothing."""
        notes = []
        for _ in range(seconds):
            self.second += 1
            now_ns = _T0 + self.second * NS_PER_S
            self.received.update([*sending, unseen])
            for name in sending:
                self.streams[1, name].observe(now_ns, now_ns)
            found = self.silences.look(now_ns, self.streams.items(), {"igtl_in": dict(self.received)})
            notes += [(self.second, note.level, note.code, note.text) for note in found]
        return notes


def test_a_pause_of_a_periodic_stream_has_a_begin_and_an_end() -> None:
    one = Streams("TRANSFORM/Arm")
    assert one.pass_s(10, "TRANSFORM/Arm") == []
    assert one.pass_s(7) == [(15, Level.WARN, STREAM_SILENT, "TRANSFORM/Arm: no message for 5 s")]
    ((second, level, code, text),) = one.pass_s(3, "TRANSFORM/Arm")
    assert (second, level, code) == (18, Level.INFO, STREAM_BACK)
    assert text == "TRANSFORM/Arm: back after about 8 s"


def test_messages_that_the_guard_does_not_see_are_no_silence() -> None:
    """No peer takes them, they are denied, or the gateway is not active."""
    one = Streams("TRANSFORM/Arm")
    assert one.pass_s(10, "TRANSFORM/Arm") == []
    assert one.pass_s(20, unseen="TRANSFORM/Arm") == []
    assert one.pass_s(6) == [(35, Level.WARN, STREAM_SILENT, "TRANSFORM/Arm: no message for 5 s")]
    ((second, _, code, _),) = one.pass_s(2, unseen="TRANSFORM/Arm")
    assert (second, code) == (37, STREAM_BACK)


def test_one_of_two_links_with_a_stream_is_silent() -> None:
    one = Streams("TRANSFORM/Arm")
    one.streams[2, "TRANSFORM/Arm"] = GuardedStream("TRANSFORM/Arm", 0, watch=True)
    for _ in range(6):
        one.pass_s(1)
        for number in (1, 2):
            one.streams[number, "TRANSFORM/Arm"].observe(_T0 + one.second * NS_PER_S, _T0 + one.second * NS_PER_S)
    ((_, _, code, _),) = one.pass_s(7, "TRANSFORM/Arm")
    assert code == STREAM_SILENT, "the messages are those of the other link"


def test_a_short_pause_and_a_rare_stream_are_no_silence() -> None:
    one = Streams("TRANSFORM/Arm", "STRING/Log")
    assert one.pass_s(3, "STRING/Log") == []  # three seconds in a row, and then now and then
    for _ in range(5):
        assert one.pass_s(9, "TRANSFORM/Arm") == []
        assert one.pass_s(4) == []
        assert one.pass_s(1, "TRANSFORM/Arm", "STRING/Log") == []


def test_streams_of_a_link_that_pause_together_are_one_note() -> None:
    names = [f"TRANSFORM/{number}" for number in range(120)]
    one = Streams(*names)
    one.pass_s(6, *names)
    ((_, _, code, text),) = one.pass_s(6)
    assert code == STREAM_SILENT and text == "TRANSFORM/0, TRANSFORM/1, TRANSFORM/2 and 117 more: no message for 5 s"
    ((_, _, code, _),) = one.pass_s(2, *names)
    assert code == STREAM_BACK


def test_a_host_that_has_slept_reports_no_stream() -> None:
    one = Streams("TRANSFORM/Arm")
    one.pass_s(8, "TRANSFORM/Arm")
    one.second += 60
    assert one.pass_s(1) == []  # the messages of the sleep are still to be read
    assert one.pass_s(5, "TRANSFORM/Arm") == []


def test_a_stream_of_a_closed_link_is_forgotten() -> None:
    one = Streams("TRANSFORM/Arm")
    one.pass_s(8, "TRANSFORM/Arm")
    gone = one.streams.pop((1, "TRANSFORM/Arm"))
    assert one.pass_s(9) == []
    one.streams[1, "TRANSFORM/Arm"] = gone
    assert one.pass_s(9) == []
