"""Names that differ, however many want the same one."""

from __future__ import annotations

from igtl_gateway.base.free_names import FreeNames


def test_a_name_in_use_gets_underscores_and_then_numbers() -> None:
    names = FreeNames(("x",))
    assert [names.take(name) for name in ("a", "a", "x", "x", "b", "a")] == ["a", "a_", "x_", "x__", "b", "a__"]
    many = FreeNames()
    made = [many.take("a") for _ in range(12)]
    assert made[8:] == ["a________", "a_9", "a_10", "a_11"]


def test_no_form_of_one_name_is_another_name() -> None:
    names = FreeNames()
    wanted = ["a_9", *["a"] * 12, "a_10", "a_", *["a__"] * 3]
    made = [names.take(name) for name in wanted]
    assert len(set(made)) == len(made)


def test_thousands_of_one_name_are_short_and_found_in_a_few_steps() -> None:
    class Counted(tuple[str, ...]):
        asked = 0

        def __contains__(self, name: object) -> bool:
            Counted.asked += 1
            return super().__contains__(name)

    names = FreeNames(Counted())
    made = [names.take("a") for _ in range(4_096)]
    assert len(set(made)) == len(made)
    assert Counted.asked == 4_096  # one question each
    assert max(map(len, made)) <= len("a") + 8
