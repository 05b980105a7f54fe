"""What is reported once."""

from __future__ import annotations

import threading

from igtl_gateway.base.once import Once


def test_only_the_first_call_with_a_key_is_true() -> None:
    once = Once()
    assert [once.first("a"), once.first("a"), once.first("a", 1), once.first(), once.first("a", 1)] == [
        *(True, False, True),
        *(True, False),
    ]
    once.forget()
    assert once.first("a")


def test_from_the_bound_on_nothing_is_reported() -> None:
    once = Once(most=2)
    assert [once.first(number) for number in (0, 1, 1, 2)] == [True, True, False, False]


def test_of_several_threads_one_is_the_first() -> None:
    once, barrier, firsts = Once(), threading.Barrier(8), list[int]()

    def ask() -> None:
        barrier.wait()
        firsts.extend(number for number in range(1000) if once.first(number))

    threads = [threading.Thread(target=ask) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(firsts) == list(range(1000))
