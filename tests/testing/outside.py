"""pytest as users of the package run it: in a separate process, on a separate project."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

from tests.places import ROOT


def run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run pytest in a folder outside the project; load the plugin explicitly if it is not installed."""
    installed = any(entry.value == "igtl_gateway.testing.plugin" for entry in entry_points(group="pytest11"))
    plugin = [] if installed else ["-p", "igtl_gateway.testing.plugin"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "--rootdir", str(folder), *plugin, *arguments, str(folder)]
    return subprocess.run(command, capture_output=True, text=True, env=env, cwd=folder, check=False)
