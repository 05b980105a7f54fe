"""The verbs that this distribution adds to ``igtl-gateway``, named by the entry points in its pyproject.toml."""

from __future__ import annotations

from igtl_gateway.cli.verbs import Verb


def _own(name: str, text: str) -> Verb:
    return Verb(text, f"igtl_gateway_lab.cli.{name}", reads_files=False)


SIMULATE = _own("simulate", "play a scenario, live over ROS 2 and OpenIGTLink or into a recording")
BENCH = _own("bench", "measure latency, rate and cost, next to bare hops of the same bytes")
DEMO = _own("demo", "bridge, record, verify and replay a session within one minute")
