"""Names of topics: those of the configuration and the recording, and those in the graph.

The gateway knows each topic by one name, that of its configuration; recordings, notes and counts have this name.  In
the graph, a topic may have another one: ``--ros-args -r old:=new`` gives it, and in a namespace the topics below
``/igtl/`` move into it, so that two bridges have separate topics.  Remapping is that of rcl, and this module only asks
for it.  The way back, from the graph to the configuration, tries the names on the left of the rules.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

#: Topics below this move into the namespace of the node.
_OWN = "/igtl/"
_ARROW = ":="
_MAX_TOPICS = 4096


class GraphNames:
    """The names of topics of one node.

    Args:
        node: of rclpy.
        arguments: the arguments after ``--ros-args``.
    """

    def __init__(self, node: Any, arguments: Sequence[str]) -> None:
        self._node = node
        self._namespace = node.get_namespace().rstrip("/")
        self._remapped = [self._home(node.resolve_topic_name(name, only_expand=True)) for name in remapped(arguments)]
        self.in_gateway = lru_cache(_MAX_TOPICS)(self._in_gateway)

    def full(self, topic: str) -> str:
        """Return the name in the gateway: an absolute one as it is, a relative one in the namespace."""
        return topic if topic.startswith("/") else str(self._node.resolve_topic_name(topic, only_expand=True))

    def asked(self, topic: str) -> str:
        """Return the name that rclpy is given, which remaps it, for a name in the gateway."""
        return self._namespace + topic if topic.startswith(_OWN) else topic

    def in_graph(self, topic: str) -> str:
        """Return the name in the graph for a name in the gateway."""
        return str(self._node.resolve_topic_name(self.asked(topic)))

    def _in_gateway(self, topic: str) -> str | None:
        """Return the name in the gateway for a name in the graph; None: none of our topics has this name there.

        That is so for a name that is remapped to another one, and in a namespace for the topics below ``/igtl/``, which
        are those of another bridge.
        """
        for name in (*self._remapped, self._home(topic)):
            if self.in_graph(name) == topic:
                return name
        return None

    def _home(self, topic: str) -> str:
        """Return a name without the namespace, if that is what moved it there."""
        moved = self._namespace and topic.startswith(self._namespace + _OWN)
        return topic[len(self._namespace) :] if moved else topic


def remapped(arguments: Sequence[str]) -> Iterator[str]:
    """Yield the names of topics on the left of rules such as ``-r old:=new``, without the name of a node."""
    for option, rule in pairwise(arguments):
        if option not in ("-r", "--remap") or _ARROW not in rule:
            continue
        left = rule.partition(_ARROW)[0].removeprefix("rostopic://")
        name = left.rpartition(":")[2]
        if not name.startswith(("__", "//")):  # of a node, of a service
            yield name
