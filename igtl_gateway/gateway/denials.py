"""Deny lists: types of messages that are not forwarded, so that a viewer cannot command a robot.

The settings ``deny_in`` (from peers) and ``deny_out`` (to peers) are globs of type names; case does not matter.  A type
is denied under each of its names (``QTRANS`` with ``POSITION``, ``GET_TRANS`` with ``GET_TRANSFORM``).  A BIND is
denied if one of its children is: a reader would unpack it.
"""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.base.errors import WireError
from igtl_gateway.base.globs import matches
from igtl_gateway.wire import Message
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.query import split_query
from igtl_gateway.wire.registry import ALIASES, read_child

#: Maximum number of cached results, in case a peer invents names.
_MAX_KNOWN = 1_024


class Denials:
    """The deny list of one direction; false if it is empty."""

    def __init__(self, globs: Sequence[str]) -> None:
        self._globs: tuple[str, ...] = ()
        self._known: dict[str, bool] = {}
        self.change(globs)

    def change(self, globs: Sequence[str]) -> None:
        """Deny these types from now on, and no others."""
        self._globs = tuple(glob.upper() for glob in globs)
        self._known.clear()

    def __bool__(self) -> bool:
        return bool(self._globs)

    def type(self, igtl_type: str) -> bool:
        """Return whether messages of this type are denied."""
        if not self._globs:
            return False
        denied = self._known.get(igtl_type)
        if denied is None:
            denied = any(matches(glob, name.upper()) for name in _names(igtl_type) for glob in self._globs)
            if len(self._known) < _MAX_KNOWN:
                self._known[igtl_type] = denied
        return denied

    def message(self, message: Message) -> str:
        """Return the denied type of a message or of a child in it; ``""`` if the message may pass."""
        return self.content(visible(message.type), message.content) if self._globs else ""

    def content(self, igtl_type: str, content: Body) -> str:
        """As ``message``, for a type and a content."""
        if self.type(igtl_type):
            return igtl_type
        if self._globs and isinstance(content, Bind):
            return next(filter(None, map(self._child, content.children)), "")
        return ""

    def _child(self, child: BindChild) -> str:
        name = visible(child.type)
        if self.type(name):
            return name
        if name != "BIND":
            return ""
        try:
            return self.content(name, read_child(child))
        except WireError:  # no reader can unpack it
            return ""


def _names(igtl_type: str) -> set[str]:
    """Return all names of a type."""
    names = {igtl_type, ALIASES.get(igtl_type, igtl_type)}
    if query := split_query(igtl_type):
        names |= {"_".join(query), f"{query[0]}_{ALIASES.get(query[1], query[1])}"}
    return names
