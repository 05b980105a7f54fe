"""Compiles the optional C part of the package where there is a compiler; without one, the package is pure Python.

What the part (``igtl_gateway/convert/_express.c``) does, Python does with the same results, only slower.
"""

from __future__ import annotations

import shlex
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = Path("igtl_gateway/convert/_express.c")
#: Results have to be those of Python's floats: no fused or reordered arithmetic.
FLAGS = ("-O3", "-fPIC", "-shared", "-std=gnu11", "-ffp-contract=off", "-Wall", "-Wextra")


def compiled(root: Path) -> Path | None:
    """Compile beside the source; None, and a word of why, where that is not possible."""
    target = root / SOURCE.with_suffix(sysconfig.get_config_var("EXT_SUFFIX") or ".so")
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    command = [compiler, *FLAGS, f"-I{sysconfig.get_path('include')}", "-o", str(target), str(root / SOURCE), "-lm"]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        target.unlink(missing_ok=True)
        return None
    return target


class Hook(BuildHookInterface[Any]):
    """Hatch calls it before a wheel is made, an editable one included."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and make it part of the wheel."""
        if self.target_name != "wheel":
            return
        root = Path(self.root)
        target = compiled(root)
        if target is None:
            self.app.display_warning("no C compiler or no Python headers: igtl-gateway is installed without its C part")
            return
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
        build_data["force_include"][str(target)] = str(target.relative_to(root))
