"""Where the library is that is preloaded into programs."""

from __future__ import annotations

import sysconfig
from pathlib import Path

from igtl_gateway.addon import Unavailable

_NAME = "_preload"


def library_path() -> Path:
    """Return the place of the library.

    Raises:
        Unavailable: the package was installed without it: no C compiler, or not Linux.
    """
    suffix = sysconfig.get_config_var("EXT_SUFFIX") or ".so"
    path = Path(__file__).with_name("preload") / f"{_NAME}{suffix}"
    if not path.is_file():
        raise Unavailable(
            f"resim: found no {path.name}, which needs Linux and a C compiler when igtl-gateway is installed"
        )
    return path
