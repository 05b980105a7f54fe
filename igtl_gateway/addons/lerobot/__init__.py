"""Training sets for LeRobot (formats v2.1 and v3.0) from recordings and a recipe; see ``docs/how-to/lerobot.md``.

``dataset`` gives the samples without writing a set.  The names load at their first use: the list of verbs imports this
package, and needs none of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igtl_gateway.addons.lerobot.recorded import RecordedSet, SetEpisode, dataset

__all__ = ["RecordedSet", "SetEpisode", "dataset"]


def __getattr__(name: str) -> Any:
    """Import the names of the package when one of them is first used.  Raises Unavailable without the extra."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from igtl_gateway.addon.processes import extras

    with extras.in_use("lerobot"):
        from igtl_gateway.addons.lerobot import recorded
    globals().update({each: getattr(recorded, each) for each in __all__})
    return globals()[name]
