"""The denied messages of a bridge, as lines."""

from __future__ import annotations

from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.wire.registry import BODIES


def denials(config: Config) -> list[str]:
    """Return the denied messages as lines, with a mark at a name that matches no known type: it might be misspelt."""
    lines = []
    for globs, way in ((config.deny_in, "from"), (config.deny_out, "to")):
        known = [
            glob if any(map(Denials([glob]).type, BODIES)) else f"{glob} (matches no known type)" for glob in globs
        ]
        if known:
            lines.append(f"denied       {way} peers: {', '.join(known)}")
    return lines
