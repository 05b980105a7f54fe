"""Calls of services: right ones are answered, all others refused, and none blocks the rest."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import Any

import pytest
import zenoh

from igtl_gateway.addons.zenoh import names
from igtl_gateway.addons.zenoh.own_node import TypeHashes
from igtl_gateway.addons.zenoh.services import TriggerRequest, TriggerResponse
from igtl_gateway.convert.igtl_msgs import MetadataItem, SendCommandRequest, SendCommandResponse
from tests.addons.zenoh.routers import client, router
from tests.addons.zenoh.test_edge import DOMAIN, GID, VALID, Side, port, sides, started, until

__all__ = ["port", "sides"]

TRIGGER, COMMAND = "std_srvs/srv/Trigger", "igtl_msgs/srv/SendCommand"
HASHES = TypeHashes()


def ask(session: Any, name: str, ros_type: str, payload: bytes | None, attachment: bytes | None = VALID) -> list[Any]:
    """The replies to a call; of an error its text."""
    key = names.data_key(DOMAIN, name, ros_type, HASHES.of(ros_type))
    replies = session.get(
        key, payload=payload, attachment=attachment, target=zenoh.QueryTarget.ALL_COMPLETE, timeout=30.0
    )
    return [reply.ok or reply.err.payload.to_string() for reply in replies]


def wait_for(session: Any, *services: str) -> None:
    """Wait until the services are in the graph."""

    def there() -> bool:
        tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get(f"{names.SPACE}/**") if reply.ok]
        found = [names.read_token(token) for token in tokens]
        return {*services} == {each.topic for each in found if each.kind is names.Kind.SERVER}

    until(there)


def served(sides: ExitStack, port: int, session: Any) -> Side:
    side = started(sides, port)

    def trigger(_request: Any, response: Any) -> Any:
        response.success, response.message = True, "fertig ✓"
        return response

    def command(request: SendCommandRequest, response: Any) -> Any:
        response.status, response.content = 1, request.content
        response.metadata = [MetadataItem(each.key, each.encoding, each.value) for each in request.metadata]
        if request.name == "fail":
            raise OSError("broken")
        return response

    assert side.edge.serve("~/save", TRIGGER, trigger)
    assert side.edge.serve("/send", COMMAND, command)
    assert not side.edge.serve("/other", "lab_msgs/srv/Secret", trigger)
    assert "ros_unknown_type" in side.codes()
    wait_for(session, "/igtl_gateway/save", "/send")
    return side


def test_calls_are_answered_with_number_and_gid_of_the_caller(port: int, sides: ExitStack) -> None:
    with router(port), client(port) as plain:
        served(sides, port, plain)
        (reply,) = ask(plain, "/igtl_gateway/save", TRIGGER, TriggerRequest().pack())
        assert TriggerResponse.unpack(reply.payload.to_bytes()) == TriggerResponse(True, "fertig ✓")
        sequence, stamp_ns, gid = names.read_attachment(reply.attachment.to_bytes())
        assert (sequence, gid, stamp_ns > 0) == (7, GID, True)
        items = (MetadataItem("key", 3, "value"),)
        request = SendCommandRequest("Robot", "move", "<x/>", items, 1, 2.5)
        (reply,) = ask(plain, "/send", COMMAND, request.pack())
        answer = SendCommandResponse.unpack(reply.payload.to_bytes())
        assert answer == SendCommandResponse(1, "", "<x/>", items, 0)


@pytest.mark.parametrize(
    ("payload", "attachment", "words"),
    [
        (TriggerRequest().pack(), None, "attachment of 0 bytes"),
        (TriggerRequest().pack(), b"x", "attachment of 1 byte"),
        (None, VALID, "request of 0 bytes"),
        (b"\0", VALID, "CDR"),
    ],
)
def test_wrong_calls_are_refused(
    payload: bytes | None, attachment: bytes | None, words: str, port: int, sides: ExitStack
) -> None:
    with router(port), client(port) as plain:
        side = served(sides, port, plain)
        (reply,) = ask(plain, "/igtl_gateway/save", TRIGGER, payload, attachment)
        assert isinstance(reply, str) and words in reply
        side.wait_code("ros_call_refused")
        (reply,) = ask(plain, "/igtl_gateway/save", TRIGGER, TriggerRequest().pack())
        assert not isinstance(reply, str)


def test_an_answer_that_fails_and_calls_that_wait_do_no_harm(port: int, sides: ExitStack) -> None:
    release = threading.Event()
    sides.callback(release.set)
    with router(port), client(port) as plain:
        side = served(sides, port, plain)
        assert ask(plain, "/send", COMMAND, SendCommandRequest("", "fail", "").pack()) == ["broken"]

        def wait(_request: Any, response: Any) -> Any:
            release.wait(10.0)
            return response

        assert side.edge.serve("/slow", TRIGGER, wait)
        wait_for(plain, "/igtl_gateway/save", "/send", "/slow")
        key = names.data_key(DOMAIN, "/slow", TRIGGER, HASHES.of(TRIGGER))
        answers: list[Any] = []
        changed = threading.Condition()

        def on_reply(reply: Any) -> None:
            with changed:
                answers.append(reply.ok is not None)
                changed.notify_all()

        for _ in range(105):
            plain.get(key, on_reply, payload=TriggerRequest().pack(), attachment=VALID, timeout=20.0)
        with changed:
            assert changed.wait_for(lambda: len(answers) == 5, 10.0)
            assert not any(answers)
        release.set()
        with changed:
            assert changed.wait_for(lambda: len(answers) == 105, 10.0)
        assert sum(answers) == 100
