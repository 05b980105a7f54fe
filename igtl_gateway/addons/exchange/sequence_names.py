"""Names in a tracked sequence: the streams of a session that it can have, and the names of their transforms."""

from __future__ import annotations

import re
from dataclasses import dataclass

from igtl_gateway.addon.reading import Kind

#: What divides the two frames in a name.
_TO = re.compile(r"To(?=[A-Z])")


@dataclass(frozen=True, slots=True)
class StreamSource:
    """A stream of the session: received or sent, and by one peer if several send it in turn.

    Attributes:
        kind: IGTL_IN or IGTL_OUT.
        stream: ``TYPE/device``.
        link: number of the link; 0: of all.
    """

    kind: Kind
    stream: str
    link: int = 0

    def __str__(self) -> str:
        """The glob of ``--streams`` that selects it."""
        return f"{'in' if self.kind.is_input else 'out'}:{self.stream}" + (f"@{self.link}" if self.link else "")

    @property
    def name(self) -> str:
        """The device."""
        return self.stream.partition("/")[2]


def name_in_file(device: str) -> str:
    """Return the name of a transform in the file, which has letters and digits only."""
    return re.sub(r"[^A-Za-z0-9]", "", device) or "Unnamed"


def another_name(name: str, number: int) -> str:
    """Return a name with a number: the second ``ProbeToTracker`` gets it before ``To``."""
    found = _TO.search(name, 1)
    at = found.start() if found else len(name)
    return f"{name[:at]}{number}{name[at:]}"
