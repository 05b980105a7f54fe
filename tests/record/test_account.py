"""The entries that a recording lacks, counted by stream."""

from __future__ import annotations

from collections import Counter

import pytest

from igtl_gateway.record import account as module
from igtl_gateway.record.account import Account
from igtl_gateway.record.bridge_end import BridgeGone
from igtl_gateway.record.selection import MAX_STREAMS, OTHERS
from tests.record import samples

S = 1_000_000_000


def gone(_what: str) -> dict[str, int]:
    raise BridgeGone


def test_the_streams_beyond_the_bound_are_counted_together() -> None:
    account = Account()
    for number in range(MAX_STREAMS + 2):
        account.count(samples.igtl(number + 1, device=f"device {number}"))
    account.count(samples.igtl(1, device="device 0"))
    assert len(account.dropped) == MAX_STREAMS + 1
    assert account.dropped[OTHERS] == account.dropped[samples.igtl(1, device="device 0").channel] == 2


def test_what_the_queue_did_not_take_is_known_without_the_bridge() -> None:
    account = Account()
    account.ask(lambda what: {"a": 3} if what == "drops" else {}, 3)
    assert account.not_queued == {"a": 3}
    account.ask(gone, 5)
    assert account.not_queued == {"a": 3, OTHERS: 2}
    account.ask(gone, 4)
    assert account.not_queued == {"a": 3, OTHERS: 2}


def test_a_note_reports_what_is_new_once_a_second() -> None:
    account = Account()
    assert not account.is_note_due(0, S)
    assert account.is_note_due(3, S)
    assert account.take_unnoted(lambda _: {"a": 3}, 3, S) == Counter(a=3)
    assert not account.is_note_due(4, 2 * S - 1)
    assert account.is_note_due(4, 2 * S) and not account.is_note_due(3, 2 * S)
    assert account.take_unnoted(lambda _: {"a": 3, "b": 1}, 4, 2 * S) == Counter(b=1)


def test_a_pause_has_what_was_left_out_in_it() -> None:
    account = Account()
    account.pause(7)
    assert account.left_out_since_pause(12) == 5


def test_a_stream_and_a_type_are_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_STREAMS", 2)
    account = Account()
    assert [account.is_first_refused(stream) for stream in ("a", "a", "b", "c")] == [True, False, True, False]
    assert [account.is_first_undefined(name) for name in ("a", "a", "b", "c")] == [True, False, True, True]
