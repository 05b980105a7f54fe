"""pytest as a user of the package runs it: in a process of its own, on a project of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

from tests.integration.bridge import ROOT


def run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """pytest on a folder outside the project; the plugin is loaded by hand where it is not installed."""
    installed = any(entry.value == "igtl_gateway.testing.plugin" for entry in entry_points(group="pytest11"))
    plugin = [] if installed else ["-p", "igtl_gateway.testing.plugin"]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pytest", "-q", "--rootdir", str(folder), *plugin, *arguments, str(folder)]
    return subprocess.run(command, capture_output=True, text=True, env=env, cwd=folder, check=False)
