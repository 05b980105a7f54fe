"""What every test shares: a ROS 2 of its own, Hypothesis profiles, the material beside the project.

The environment is set on import, before any test module can start ROS 2, and set firmly rather than by
default: a test must never talk to the graph of a robot that happens to be configured in the user's shell.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

#: Domains that runs on one machine share by process number: 1 to 100, away from the default 0.
DOMAINS = 100

#: Vectors, captured traffic and other material that may not be copied into the project.
SHARED = Path(__file__).parents[2] / "shared"

_ros_log_dir = tempfile.mkdtemp(prefix="igtl-gateway-ros-log-")
# Not a fixture: child processes of the last tests may still write there.
atexit.register(shutil.rmtree, _ros_log_dir, ignore_errors=True)

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % DOMAINS)
os.environ["ROS_LOG_DIR"] = _ros_log_dir

# Compiled modules are kept, whatever the shell says: a run starts some hundred Pythons of ours, and reading 240 test
# files with their assertions takes each worker 16 s instead of 5.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# "fast" is the same on every run, so a red test is red for everybody; "deep" looks for new examples.
# No deadline: how long an example takes says more about the machine than about us.
settings.register_profile("fast", max_examples=50, derandomize=True, deadline=None)
settings.register_profile("deep", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what is marked ``ros`` where there is no ROS 2."""
    if find_spec("rclpy") is not None:
        return
    absent = pytest.mark.skip(reason="no ROS 2 here: install the extra 'ros' or source a ROS 2")
    for item in items:
        if "ros" in item.keywords:
            item.add_marker(absent)


@pytest.fixture(autouse=True)
def _no_streams_left() -> Iterator[None]:
    """rerun keeps the thread of every recording stream until it is asked to look for those that nobody holds."""
    yield
    if rerun := sys.modules.get("rerun"):
        rerun.bindings.flush_and_cleanup_orphaned_recordings()


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with the material beside the project; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("no folder 'shared' beside the project")
    return SHARED
