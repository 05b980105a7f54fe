from __future__ import annotations

import json
import subprocess
import sys

import pytest

from igtl_gateway.addons.page.starting import REPLAYS, WORK
from tests.integration.bridge import environment

_PROGRAM = """
import json, os, sys, threading
from igtl_gateway.addon.processes import Child, stand_back
from igtl_gateway.addons.page.starting import Starters, directly

base = os.nice(0)
starters = Starters()
stand_back(10)
found = {}

def look(name, start):
    lines = []
    child = start(lambda: Child("x", [sys.executable, "-c", "import os; print(os.nice(0))"], on_line=lines.append))
    child.wait()
    child.kill()
    found[name] = int(lines[0])

for name, start in (("page", directly), ("work", starters.work), ("replays", starters.replays)):
    thread = threading.Thread(target=look, args=(name, start))  # as that of a request
    thread.start()
    thread.join()
print(json.dumps([base, found]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a thread has no priority of its own")
def test_what_a_person_waits_for_does_not_stand_back_with_the_page() -> None:
    """A replay of 233 MB opened after 62 s, and Verify did not end: both had a tenth of a processor."""
    text = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env=environment(),
        capture_output=True,
        text=True,
        check=True,
        start_new_session=True,  # else the session of the tests stands back, too, and never again forward
    )
    base, found = json.loads(text.stdout)
    expected = {"page": 10, "work": WORK, "replays": REPLAYS}
    assert found == {name: min(19, base + niceness) for name, niceness in expected.items()}
