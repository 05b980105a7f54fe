"""Identifiers of goals and clients are compared by the order of their appearance."""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.app.comparison import compare_recordings
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.replay.compare import EXACT
from igtl_gateway.replay.random_ids import numbered_ids
from tests import exchanges


def test_goals_are_counted_by_action_and_clients_by_service_and_side() -> None:
    rows = [*exchanges.both("/b", "p/srv/S", 0, 1, b"\1", None), *exchanges.goals()]
    broken = [(9, "/fib/_action/feedback", "p/action/A_FeedbackMessage", b"\0"), (9, "/b/_service_event", "", b"")]
    entries = [Entry(1, ns, Kind.ROS_IN, topic, of, (data,)) for ns, topic, of, data in [*broken, *rows]]
    found = numbered_ids(entries)
    assert {key: found[key] for key in map(exchanges.goal_id, exchanges.GOALS)} == {
        exchanges.goal_id(order): f"goal {number}" for number, order in enumerate(exchanges.GOALS, 1)
    }
    assert found[b"me" + bytes(14)] == "client 1"


def test_two_runs_differ_in_what_they_say_and_not_in_the_names_of_goals(tmp_path: Path) -> None:
    """Goals and clients have random identifiers; a message of another goal is a difference, also in one file only."""
    rows = [*exchanges.calls(), *exchanges.goals()]
    path = exchanges.write(tmp_path / "a.mcap", rows)

    def named(data: bytes) -> bytes:
        for order in exchanges.GOALS:
            data = data.replace(exchanges.goal_id(order), exchanges.goal_id(order + 100))
        return data.replace(b"me" + bytes(14), b"you" + bytes(13))

    other = exchanges.write(tmp_path / "b.mcap", [(*row[:3], named(row[3])) for row in rows])
    assert compare_recordings(path, other, (), EXACT).equal
    at = next(at for at, row in enumerate(rows) if "feedback" in row[1] and exchanges.goal_id(9) in row[3])
    wrong = rows[at][3].replace(exchanges.goal_id(9), exchanges.goal_id(3))
    mixed = exchanges.write(tmp_path / "c.mcap", [*rows[:at], (*rows[at][:3], wrong), *rows[at + 1 :]])
    for one in (path, other):
        (differing,) = (each for each in compare_recordings(one, mixed, (), EXACT).streams if not each.equal)
        assert differing.first and (differing.first.delta.field, differing.first.delta.one) == ("goal_id", "goal 2")
