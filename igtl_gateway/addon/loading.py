"""How the names of the surface load: each at its first use, from the module where it is documented."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

#: Modules, and their names with spaces between; ``HERE=THERE`` where the name there alone would be unclear.  A name
#: that is a module below it is that module.
Homes = tuple[tuple[str, str], ...]


def home_of(homes: Homes) -> dict[str, tuple[str, str]]:
    """Return name → the module that has it, and its name there."""
    found = {}
    for module, names in homes:
        for word in names.split():
            name, _, there = word.partition("=")
            found[name] = module, there or name
    return found


def at_first_use(place: str, homes: Homes) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of the module ``place``, whose names are those of other modules."""
    known = home_of(homes)
    names = vars(sys.modules[place])

    def load(name: str) -> Any:
        if name not in known:
            raise AttributeError(f"module {place!r} has no attribute {name!r}")
        home, there = known[name]
        module = import_module(f"igtl_gateway.{home}")
        found = getattr(module, there) if hasattr(module, there) else import_module(f"{module.__name__}.{there}")
        names[name] = found
        return found

    return load, lambda: sorted({*names, *known})
