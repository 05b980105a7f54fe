"""What has failed of a recording, and when its disk is tried again."""

from __future__ import annotations

from igtl_gateway.record.failures import Failures

S = 1_000_000_000


def test_the_first_failure_is_that_of_the_recording() -> None:
    failures = Failures()
    assert failures.summary == ""
    failures.taken_away = "taken"
    assert failures.summary == "taken"
    assert failures.fail("one") and not failures.fail("one") and failures.fail("two")
    assert (failures.present, failures.first, failures.summary) == ("two", "one", "one")
    failures.clear()
    assert (failures.present, failures.first) == ("", "one")


def test_a_disk_is_tried_four_times_after_each_time_up_to_a_minute() -> None:
    failures, now_ns, times = Failures(), 100 * S, []
    for _ in range(30):
        failures.try_later(now_ns)
        assert failures.again_ns and not failures.is_due(failures.again_ns - 1) and failures.is_due(failures.again_ns)
        times.append((failures.again_ns - now_ns) // S)
        now_ns = failures.again_ns
    assert times == [1] * 4 + [2] * 4 + [4] * 4 + [8] * 4 + [16] * 4 + [32] * 4 + [60] * 6
    assert failures.works_again(now_ns) == sum(times)
    assert failures.again_ns is None and not failures.is_due(1 << 62)


def test_one_that_has_worked_for_long_is_tried_soon() -> None:
    for works_s, again_s in ((30, 2), (31, 1)):
        failures, now_ns = Failures(), 100 * S
        for _ in range(4):
            failures.try_later(now_ns)
        failures.works_again(now_ns)
        now_ns += works_s * S
        failures.try_later(now_ns)
        assert failures.again_ns == now_ns + again_s * S


def test_the_time_that_is_missing_begins_with_the_first_failure() -> None:
    failures = Failures()
    failures.try_later(100 * S)
    failures.works_again(101 * S)
    failures.try_later(105 * S)  # at once again: it did not work
    assert failures.works_again(106 * S) == 6.0
    failures.try_later(206 * S)
    assert failures.works_again(207 * S) == 1.0
