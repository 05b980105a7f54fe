"""The account of an export: sums that close, reasons with their numbers, one row for each stream."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addon.reading import Entry, Kind
from igtl_gateway.addons.exchange.account import ExportAccount, ExportedStream


def entry(channel: str = "/a", ros_type: str = "t", kind: Kind = Kind.ROS_IN) -> Entry:
    return Entry(1, 5, kind, channel, ros_type)


def test_each_stream_has_one_row_which_counts_what_is_declared() -> None:
    account = ExportAccount()
    first = account.row(entry())
    assert account.row(entry()) is first and first.declared == 2
    others = [account.row(entry("/b")), account.row(entry(ros_type="u")), account.row(entry(kind=Kind.ROS_OUT))]
    assert account.rows == [first, *others] and len({id(row) for row in account.rows}) == 4
    assert (first.stream, first.type, first.unit) == ("/a", "t", "messages")


def test_parts_have_rows_of_their_own_which_declare_nothing_by_themselves() -> None:
    account = ExportAccount()
    cells = account.part(entry(), "cells")
    assert account.part(entry(), "cells") is cells
    assert account.part(entry(), "attributes") is not cells and account.part(entry("/b"), "cells") is not cells
    assert (cells.declared, cells.unit, cells.stream, cells.type) == (0, "cells", "/a", "t")
    assert len(account.parts) == 3 and account.rows == []


def test_reasons_have_their_numbers_when_there_are_several() -> None:
    row = ExportedStream("/a", 10, "t", taken=3)
    row.leave_out("too long", 2)
    assert (row.left_out, row.why, row.good) == (2, "too long", False)
    row.leave_out("too long")
    row.leave_out("too odd", 4)
    assert row.why == "3: too long; 4: too odd"
    assert (row.left_out, row.good, row.failed) == (7, True, 0)


def test_what_failed_is_never_good_although_the_sum_closes() -> None:
    row = ExportedStream("/a", 2, "t", taken=1)
    row.fail("the disk is full")
    assert (row.failed, row.left_out, row.why, row.declared) == (1, 1, "the disk is full", row.taken + row.left_out)
    assert not row.good


def test_a_hostile_file_cannot_cause_reasons_without_number() -> None:
    row = ExportedStream("/a", 1000, "t")
    for number in range(1000):
        row.leave_out(f"reason {number}")
    assert len(row.reasons) == 6
    assert row.reasons["other reasons"] == 995 and row.good
    row.leave_out("reason 3", 5)
    assert row.reasons["reason 3"] == 6, "what is listed goes on"


@given(st.lists(st.tuples(st.sampled_from("abcdefgh"), st.integers(1, 5), st.booleans())))
def test_reasons_add_up_to_what_is_left_out(steps: list[tuple[str, int, bool]]) -> None:
    row = ExportedStream("/a", 0, "t")
    for why, count, fails in steps:
        if fails:
            row.fail(why)
        else:
            row.leave_out(why, count)
    assert sum(row.reasons.values()) == row.left_out
    assert row.failed == sum(fails for *_, fails in steps)
    row.declared = row.left_out
    assert row.good == (not row.failed)
