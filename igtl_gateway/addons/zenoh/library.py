"""zenoh and the hash of its gids, imported when a session opens: an extra installs them."""

from __future__ import annotations

import importlib
import re
from typing import Any

from igtl_gateway.addon import RosError
from igtl_gateway.addon import first_line as whole_first_line
from igtl_gateway.addon.processes import expect_threads_of, missing

#: Zenoh ends its errors with the place in its source.
_PLACE = re.compile(r"!?\s+at \S+\.rs:[0-9]+\.?")


def import_zenoh() -> Any:
    """Return the module with its part ``ext``.  Raises RosError if it, or what it is used with, is missing."""
    import_xxhash()
    try:
        zenoh = importlib.import_module("zenoh")
        importlib.import_module("zenoh.ext")
    except ImportError as error:
        raise RosError(missing("zenoh", error)) from error
    expect_threads_of("zenoh")
    return zenoh


def import_xxhash() -> Any:
    """Return the module.  Raises RosError if it is missing."""
    try:
        return importlib.import_module("xxhash")
    except ImportError as error:
        raise RosError(missing("xxhash", error)) from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, without places in the source of Zenoh."""
    return _PLACE.sub("", whole_first_line(error))
