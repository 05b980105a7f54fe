"""Compiles the optional C parts of the package where there is a compiler; without one, the package is pure Python.

What these parts do, Python does with the same results, only slower.
"""

from __future__ import annotations

import shlex
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = (
    Path("igtl_gateway/convert/_express.c"),
    Path("igtl_gateway/passage/_passage.c"),
    Path("igtl_gateway/record/_queue.c"),
    Path("igtl_gateway/sessionfile/_chunk.c"),
)
#: Results have to be those of Python's floats: no fused or reordered arithmetic.
FLAGS = ("-O3", "-fPIC", "-shared", "-std=gnu11", "-ffp-contract=off", "-Wall", "-Wextra")


def compiled(root: Path, source: Path) -> Path | None:
    """Compile a source, with the result beside it; None where that is not possible."""
    target = root / source.with_suffix(sysconfig.get_config_var("EXT_SUFFIX") or ".so")
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    include = f"-I{sysconfig.get_path('include')}"
    command = [compiler, *FLAGS, include, "-o", str(target), str(root / source), "-lm", "-pthread"]
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
        for source in SOURCES:
            target = compiled(root, source)
            if target is None:
                cause = "no C compiler, no Python headers, or a system that lacks what it uses"
                self.app.display_warning(f"{cause}: igtl-gateway is installed without {source.name}")
                continue
            build_data["pure_python"] = False
            build_data["infer_tag"] = True
            build_data["force_include"][str(target)] = str(target.relative_to(root))
