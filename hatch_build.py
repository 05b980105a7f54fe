"""Compiles the optional C parts of the package where there is a compiler; without one, the package is pure Python.

What these parts do, Python does with the same results, only slower.  ``IGTL_GATEWAY_PURE=1`` leaves them out, for the
wheel of machines that the compiled wheels do not fit.

``IGTL_GATEWAY_AHEAD=FOLDER`` adds the ROS packages that were compiled ahead to a wheel with C parts
(:mod:`igtl_gateway.edges.ros_interfaces.cache`).

The result does not depend on the folder of the build: an editable installation has it beside the source; a wheel
is made from a temporary folder, so that it never contains the result for another Python.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).resolve().parent
#: The parts: a library for each ``_NAME.c`` below the package, made with the headers beside and below it.  Without the
#: folder of a part, nothing of it is left.
SOURCES = tuple(sorted(path.relative_to(ROOT) for path in (ROOT / "igtl_gateway").rglob("_*.c")))
#: Results have to be those of Python's floats: no fused or reordered arithmetic.  No -march: the wheel is for every
#: processor of its architecture, and the parts with AVX2 are chosen at run time.
FLAGS = ("-O3", "-fPIC", "-shared", "-std=gnu11", "-ffp-contract=off", "-Wall", "-Wextra")


def compiled(root: Path, source: Path, folder: Path) -> Path | None:
    """Compile ``source``, a path relative to ``root``, to the same path below ``folder``; None if it is impossible."""
    target = folder / source.with_suffix(sysconfig.get_config_var("EXT_SUFFIX") or ".so")
    target.parent.mkdir(parents=True, exist_ok=True)
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    include = f"-I{sysconfig.get_path('include')}"
    # The path of the source is relative, because the compiler writes it into the result.
    command = [compiler, *FLAGS, include, "-o", str(target), str(source), "-lm", "-pthread"]
    try:
        subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
    except (OSError, subprocess.CalledProcessError):
        target.unlink(missing_ok=True)
        return None
    return target


class Hook(BuildHookInterface[Any]):
    """Hatch calls it before a wheel is made, an editable one included."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and make it part of the wheel; ``version`` is ``standard`` or ``editable``."""
        if self.target_name != "wheel" or os.environ.get("IGTL_GATEWAY_PURE") == "1":
            return
        root = Path(self.root)
        self._temporary = tempfile.TemporaryDirectory()
        folder = root if version == "editable" else Path(self._temporary.name)
        for source in SOURCES:
            target = compiled(root, source, folder)
            if target is None:
                cause = "no C compiler, no Python headers, or a system that lacks what it uses"
                self.app.display_warning(f"{cause}: igtl-gateway is installed without {source.name}")
                continue
            build_data["pure_python"] = False
            build_data["infer_tag"] = True
            build_data["force_include"][str(target)] = str(target.relative_to(folder))
        if ahead := os.environ.get("IGTL_GATEWAY_AHEAD"):
            build_data["force_include"][ahead] = "igtl_gateway/edges/ros_interfaces/compiled"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the temporary folder."""
        if hasattr(self, "_temporary"):
            self._temporary.cleanup()
