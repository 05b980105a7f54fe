"""The readers of the JavaScript world: @mcap/core with CDR decoding sees what we see.

Opt-in, since they come from another package manager: ``npm install @mcap/core @mcap/nodejs @mcap/support
@foxglove/rosmsg @foxglove/rosmsg2-serialization`` in a folder of your own, and ``IGTL_GATEWAY_NODE`` names it.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from igtl_gateway.replay.mcap_reader import SessionFile
from tests.test_fixtures import NAMES

FOLDER = Path(os.environ.get("IGTL_GATEWAY_NODE", ""))
PROGRAM = Path(__file__).with_name("count.mjs")
FIXTURES = Path(__file__).parents[2] / "fixtures"


@pytest.mark.skipif("IGTL_GATEWAY_NODE" not in os.environ, reason="opt-in: IGTL_GATEWAY_NODE names no folder")
@pytest.mark.parametrize("name", NAMES)
def test_every_message_is_decoded(name: str) -> None:
    path = FIXTURES / f"{name}.mcap"
    shutil.copy(PROGRAM, FOLDER)  # a module finds its packages beside itself
    command = ["node", PROGRAM.name, str(path)]
    told = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=True, timeout=60)
    expected: Counter[str] = Counter()
    with SessionFile.open(path) as file:
        for channel in file.channels:
            expected[channel.topic] += channel.count
    assert json.loads(told.stdout) == expected
