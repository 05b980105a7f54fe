"""Frozen values that are fast to create, for objects that are created several times per message.

Each field of a frozen dataclass takes 0.3 µs to set (3 µs for an ``Entry``; 0.5 µs if it is not frozen).  For the type
checker, which finds every assignment, ``@value(frozen=True, slots=True)`` is ``@dataclass`` with these arguments.  At
run time the class is not frozen, but hashable.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dataclasses import dataclass as value
else:
    from dataclasses import dataclass

    def value(*, frozen, **options):
        """Like ``dataclass``, but ``frozen`` is not enforced."""
        assert frozen
        return dataclass(unsafe_hash=True, **options)


__all__ = ["value"]
