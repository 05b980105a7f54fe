"""A scenario is a list of inputs or a cast, and gives its session either way."""

from __future__ import annotations

import pytest

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import Gateway
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway_lab.simulate.acquisition import actors
from igtl_gateway_lab.simulate.scenario import Scenario, note_input


def test_it_is_one_or_the_other() -> None:
    with pytest.raises(ValueError, match="inputs or actors"):
        Scenario("neither", Config())
    with pytest.raises(ValueError, match="inputs or actors"):
        Scenario("both", Config(), lambda _duration_s: (), actors)


def test_inputs_have_no_cast() -> None:
    scenario = Scenario("inputs", Config(), lambda _duration_s: [note_input(5, "synthetic", "nothing")])
    assert scenario.cast() == ()
    assert [(entry.stamp_ns, entry.kind) for entry in scenario.entries()] == [(5, Kind.EDGE_NOTE)]


def test_a_cast_that_is_given_is_the_one_that_plays() -> None:
    scenario = Scenario("cast", Config(), actors=actors)
    cast, gateway = scenario.cast(1.5), Gateway(scenario.config)
    entries = list(scenario.entries(1.5, gateway, cast))
    assert all(actor.done and actor.report().good for actor in cast)
    assert gateway.ledger.to_dict()
    assert len(entries) == len(list(scenario.entries(1.5)))
