"""Whether the messages of one stream come from several peers in turn: then they are not one movement.

A peer that connects again has another link, and its stream goes on: its messages follow those of the link before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt


class Interleaving:
    """The links of a stream, message by message.

    Attributes:
        links: all links.
        is_mixed: whether a link came again after another one.
    """

    def __init__(self) -> None:
        self.links: set[int] = set()
        self.is_mixed = False
        self._last = 0

    def add(self, links: Sequence[int]) -> None:
        """Take notice of the links of the next message; of several, the first counts."""
        link = links[0] if links else 0
        if link == self._last:
            return
        self.is_mixed = self.is_mixed or link in self.links
        self.links.add(link)
        self._last = link


def is_mixed(links: npt.NDArray[Any]) -> bool:
    """Return whether a link (N,) comes again after another one."""
    runs = int(np.count_nonzero(links[1:] != links[:-1])) + 1
    return len(links) > 0 and runs > len(np.unique(links))
