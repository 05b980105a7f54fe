"""The probe of ``doctor``: answered, and neither forwarded nor lost."""

from __future__ import annotations

import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.dialogue.probing import PROBE, PROBE_DEVICE, is_reply
from igtl_gateway.wire import Message, decode
from igtl_gateway.wire.text import Status
from tests.script import Script


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("config", [Config(), Config(deny_in=("STATUS",)), Config(profile="legacy-v1")])
def test_the_probe_gets_a_reply_and_reaches_nobody(version: int, config: Config) -> None:
    script = Script(config)
    script.up(1)
    script.up(2)
    assert script.igtl(Message("STATUS", PROBE_DEVICE, PROBE, 0, version)) == ["igtl STATUS/igtl_gateway v1 to 1"]
    assert is_reply(decode(script.last[0].data()))
    counts = script.gateway.ledger.to_dict()["igtl_in"][f"STATUS/{PROBE_DEVICE}"]
    assert counts == {"received": 1, "decoded": 1, "probed": 1}


def test_a_device_with_that_name_and_another_text_is_a_device() -> None:
    script = Script()
    script.up(1)
    message = Message("STATUS", PROBE_DEVICE, Status(1, 0, "", "ready"))
    assert script.igtl(message) == [f"ros /igtl/in/{PROBE_DEVICE}/status"]
