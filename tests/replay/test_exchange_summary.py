"""Services and actions of a recording: calls with their answers, goals with their ends, and what is there in part."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.replay import exchange_summary
from igtl_gateway.replay.exchange_summary import ExchangeSummary, ends_text
from tests import exchanges
from tests.exchanges import MS, SERVICE_TYPE, Row

TOPIC = "/arm/enable/_service_event"


def summary(path: Path, rows: list[Row] | None = None) -> ExchangeSummary:
    with SessionFile.open(exchanges.write(path, rows)) as file:
        return ExchangeSummary.of(file)


def of_calls(tmp_path: Path, *events: bytes) -> dict[str, Any]:
    rows = [(at, TOPIC, f"{SERVICE_TYPE}_Event", data) for at, data in enumerate(events)]
    (found,) = summary(tmp_path / "a.mcap", rows).services
    return {key: value for key, value in found.items() if isinstance(value, int) and value}


def test_the_calls_and_goals_of_a_recording(tmp_path: Path) -> None:
    found = summary(tmp_path / "a.mcap")
    (service,), (action,) = found.services, found.actions
    assert (service["service"], service["type"]) == ("/arm/enable", SERVICE_TYPE)
    assert ends_text(service) == "3 answered, 1 without response; std_srvs/srv/SetBool"
    assert (action["action"], action["goals"], action["type"]) == ("/fib", 4, exchanges.ACTION_TYPE)
    text = "1 succeeded, 1 canceled, 1 aborted, 1 without result, 8 feedback; test_msgs/action/Fibonacci"
    assert ends_text(action) == text


def test_without_introspection_the_states_of_goals_have_their_ends(tmp_path: Path) -> None:
    rows = [row for row in exchanges.goals() if "_service_event" not in row[1]]
    (action,) = summary(tmp_path / "a.mcap", rows).actions
    assert [action[key] for key in ("goals", "succeeded", "canceled", "aborted", "open")] == [4, 1, 1, 1, 1]
    (action,) = summary(tmp_path / "b.mcap", [row for row in rows if row[1].endswith("status")]).actions
    assert (action["type"], action["succeeded"]) == ("", 1)


def test_a_goal_that_is_rejected(tmp_path: Path) -> None:
    ask = exchanges.goal_id(4)
    rows = list(exchanges.both("/fib/_action/send_goal", f"{exchanges.ACTION_TYPE}_SendGoal", 0, 1, ask, bytes(12)))
    (action,) = summary(tmp_path / "a.mcap", rows).actions
    assert (action["goals"], action["rejected"], action["open"]) == (1, 1, 0)


def test_each_side_is_counted_by_itself(tmp_path: Path) -> None:
    """They have other identifiers of the client; the server sees the calls of all clients."""
    client = [exchanges.event(kind, 0, 1, client=b"a") for kind in (0, 3)]
    server = [exchanges.event(kind, 0, number, client=b"b") for number in (1, 2) for kind in (1, 2)]
    assert of_calls(tmp_path, *client, *server) == {"calls": 2, "answered": 2, "bare": 6}
    assert of_calls(tmp_path, *client) == {"calls": 1, "answered": 1, "bare": 2}


def test_what_is_there_in_part_or_cannot_be_read(tmp_path: Path) -> None:
    events = [exchanges.event(3, 0, 1), exchanges.event(0, 0, 2), b"", exchanges.event(0, 0, 3)[:20]]
    events.append(exchanges.event(0, 0, 3)[:44] + b"\2" + bytes(11))  # two requests
    expected = {"calls": 1, "unanswered": 1, "unasked": 1, "bare": 2, "unreadable": 3}
    assert of_calls(tmp_path, *events) == expected


def test_what_is_followed_at_once_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange_summary, "_MOST", 3)
    assert of_calls(tmp_path, *(exchanges.event(0, 0, number) for number in range(50))) == {
        "calls": 50,
        "unanswered": 50,
        "bare": 50,
    }
    rows = [
        (order, "/fib/_action/status", "action_msgs/msg/GoalStatusArray", exchanges.states({order: 4 + order % 3}))
        for order in range(60)
    ]
    (action,) = summary(tmp_path / "b.mcap", rows).actions
    assert [action[key] for key in ("goals", "succeeded", "canceled", "aborted")] == [60, 20, 20, 20]


def test_info_and_slice_say_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, part = exchanges.write(tmp_path / "a.mcap"), tmp_path / "part.mcap"
    assert main(["info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    at = lines.index("  services       calls")
    assert [line.split()[:4] for line in lines[at + 1 : at + 4 : 2]] == [
        ["/arm/enable", "4", "3", "answered,"],
        ["/fib", "4", "1", "succeeded,"],
    ]
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["services"][0]["unanswered"], facts["actions"][0]["aborted"]) == (1, 1)
    with monkeypatch.context() as patch:
        patch.setattr("igtl_gateway.cli.info_run._MOST_EXCHANGES", 62)
        assert main(["info", str(path)]) == 0
        line = "  services  63 messages of services and actions: --full counts calls and goals"
        assert line in capsys.readouterr().out.splitlines()
        assert main(["info", str(path), "--full", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["services"][0]["calls"] == 4
    cut = ["slice", str(path), "-o", str(part), "--overwrite"]
    assert main([*cut, "--start", "0.001", "--end", "0.0215"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        "? /arm/enable: 1 call without response, 1 response without request"
    )
    assert main([*cut, "--streams", "/fib/_action/send_goal/**", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["incomplete"] == ["/fib: 4 goals without result"]
    whole = [*cut, "--streams", "/arm/**", "--end", "0.0285"]
    assert main(whole) == 0
    assert "?" not in capsys.readouterr().out


def test_nothing_of_other_recordings_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = exchanges.write(tmp_path / "a.mcap", [(MS, "/chatter", "std_msgs/msg/Empty", b"\0\1\0\0\0")])
    with SessionFile.open(path) as file:
        monkeypatch.setattr(file, "columns", None)
        assert (ExchangeSummary.of(file).services, ExchangeSummary.of(file).actions) == ([], [])
