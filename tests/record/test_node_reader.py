"""The readers of the JavaScript world: @mcap/core with Foxglove's parsers sees what we see, message by message.

Opt-in, since they come from another package manager: ``npm install @mcap/core @mcap/nodejs @mcap/support
@foxglove/rosmsg @foxglove/rosmsg2-serialization`` in a folder of your own, and ``IGTL_GATEWAY_NODE`` names it.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from igtl_gateway.addons.exchange.targets import export_to
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests import exchanges
from tests.places import FIXTURES
from tests.tables import table
from tests.test_fixtures import NAMES

FOLDER = Path(os.environ.get("IGTL_GATEWAY_NODE", ""))
PROGRAM = Path(__file__).with_name("foxglove.mjs")

pytestmark = pytest.mark.skipif(
    "IGTL_GATEWAY_NODE" not in os.environ, reason="opt-in: IGTL_GATEWAY_NODE names no folder"
)


@table("name", NAMES)
def test_every_message_is_parsed(name: str) -> None:
    path = FIXTURES / f"{name}.mcap"
    counts, samples = by_foxglove(path)
    expected: Counter[str] = Counter()
    with SessionFile.open(path) as file:
        for channel in file.channels:
            expected[channel.topic] += channel.count
    assert counts == expected
    assert_same(samples, path)


def test_services_and_actions_are_parsed(tmp_path: Path) -> None:
    """rosbags has no decoder of events beside it: it knows their types by other names."""
    counts, _ = by_foxglove(exchanges.write(tmp_path / "a.mcap"))
    with SessionFile.open(tmp_path / "a.mcap") as file:
        assert counts == {channel.topic: channel.count for channel in file.channels}


@table("name", NAMES)
def test_every_message_of_a_bag_is_parsed(name: str, tmp_path: Path) -> None:
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        account = export_to("rosbag2", file, tmp_path / "bag", ())
    path = tmp_path / "bag" / "bag_0.mcap"
    counts, samples = by_foxglove(path)
    expected: Counter[str] = Counter()
    for row in account.rows:
        expected[row.stream] += row.taken
    assert counts == expected
    assert_same(samples, path)


def by_foxglove(path: Path) -> tuple[dict[str, int], list[tuple[str, str, Any]]]:
    """Messages of each topic, and samples: topic, time, values."""
    shutil.copy(PROGRAM, FOLDER)  # a module finds its packages beside itself
    command = ["node", PROGRAM.name, str(path)]
    told = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=True, timeout=60)
    found = json.loads(told.stdout, object_hook=unpacked)
    return found["counts"], found["samples"]


def unpacked(value: dict[str, Any]) -> Any:
    """The numbers that JSON does not have."""
    match value:
        case {"integer": str(text)} if len(value) == 1:
            return int(text)
        case {"float": str(text)} if len(value) == 1:
            return float(text.replace("Infinity", "inf"))
    return value


def assert_same(samples: list[tuple[str, str, Any]], path: Path) -> None:
    """Compare samples with what rosbags makes of the same messages."""
    wanted = {(topic, int(time)): values for topic, time, values in samples}
    stores: dict[str, Typestore] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            values = wanted.pop((channel.topic, message.log_time), None)
            if values is None or schema is None:
                continue
            if schema.name not in stores:
                stores[schema.name] = get_typestore(Stores.EMPTY)
                stores[schema.name].register(get_types_from_msg(schema.data.decode(), schema.name))
            store = stores[schema.name]
            expected = plain(store, store.deserialize_cdr(message.data, schema.name))
            assert is_same(values, expected), (channel.topic, message.log_time, values, expected)
    assert not wanted


def plain(store: Typestore, value: Any) -> Any:
    """A message of rosbags' as dictionaries and lists."""
    ros_type = getattr(value, "__msgtype__", "")
    if ros_type:
        names = [name for name, _ in store.fielddefs[ros_type][1]]
        return {name: plain(store, getattr(value, normalize_fieldname(name))) for name in names}
    if isinstance(value, list | np.ndarray):
        return [plain(store, one) for one in (value.tolist() if isinstance(value, np.ndarray) else value)]
    return value


def is_same(found: Any, expected: Any) -> bool:
    if isinstance(expected, dict):
        return found.keys() == expected.keys() and all(is_same(found[key], expected[key]) for key in expected)
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(is_same, found, expected))
    if isinstance(expected, float) and math.isnan(expected):
        return math.isnan(found)
    return bool(found == expected)
