"""The verbs that this distribution adds to ``igtl-gateway``, named by the entry points in its pyproject.toml."""

from __future__ import annotations

from igtl_gateway.cli.verbs import MEASURE, START, Verb


def _own(name: str, text: str, group: str, place: int) -> Verb:
    return Verb(text, f"igtl_gateway_lab.cli.{name}", reads_files=False, group=group, place=place)


SIMULATE = _own("simulate", "play a scenario, live or into a recording", START, 2)
BENCH = _own("bench", "measure latency, rate and cost, next to bare hops", MEASURE, 1)
DEMO = _own("demo", "bridge, record, verify and replay a session within one minute", START, 1)
