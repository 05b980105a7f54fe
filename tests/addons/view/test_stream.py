"""Recordings of rerun as its own dataframe API reads them: a row for each message, with the values of the message."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.tables import table

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
pytest.importorskip("datafusion", reason="datafusion is not installed (rerun-sdk[catalog])")

from igtl_gateway.addons.view.clouds import columns
from igtl_gateway.cli import main
from igtl_gateway.convert.igtl_msgs import Sensor
from igtl_gateway.convert.rosmsg import PointCloud2, String, TransformStamped
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import FIXTURES

NAMES = sorted(path.stem for path in FIXTURES.glob("*.mcap"))
_OF_ROS = (Kind.ROS_IN, Kind.ROS_OUT)


class Judge:
    """All fixtures as recordings of rerun, in a server of rerun."""

    def __init__(self, folder: Path) -> None:
        from rerun.server import Server

        self.files = {name: folder / f"{name}.rrd" for name in NAMES}
        for name, path in self.files.items():
            assert main(["view", str(FIXTURES / f"{name}.mcap"), "-o", str(path), "--json"]) == 0
        sets: Any = {name: [path] for name, path in self.files.items()}
        self.server = Server(host="127.0.0.1", datasets=sets)
        self.client = self.server.client()

    def table(self, name: str, contents: str, *wanted: str) -> Any:
        """Rows of the entities ``contents`` by entry number."""
        rows = self.client.get_dataset(name).filter_contents([contents]).reader(index="entry")
        return (rows.select(*(f'"{column}"' for column in wanted)) if wanted else rows).to_arrow_table()


@pytest.fixture(scope="module")
def judge(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Judge]:
    judge = Judge(tmp_path_factory.mktemp("rrd"))
    yield judge
    judge.server.shutdown()


def said(name: str, topic: str = "") -> list[Entry]:
    """The ROS messages of a fixture."""
    with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
        return [entry for entry in file.entries() if entry.kind in _OF_ROS and topic in ("", entry.channel)]


@table("name", NAMES)
def test_nothing_is_static_and_has_rows(name: str, judge: Judge) -> None:
    from rerun.chunk import RrdReader

    found: dict[bool, set[tuple[str, str]]] = {True: set(), False: set()}
    for chunk in RrdReader(str(judge.files[name])).store().stream():
        names = chunk.to_record_batch().schema.names
        found[chunk.is_static] |= {(chunk.entity_path, column) for column in names if ":" in column}
    assert found[True]
    assert found[True] & found[False] == set()


@table("name", NAMES)
def test_every_message_is_a_row(name: str, judge: Judge) -> None:
    expected = Counter(entry.channel for entry in said(name))
    assert {topic: judge.table(name, topic, "entry").num_rows for topic in expected} == expected


@pytest.mark.parametrize("contents", ["/star/tool", "/star/**"])
def test_poses_are_those_of_the_messages(contents: str, judge: Judge) -> None:
    entries = {entry.seq: TransformStamped.unpack(entry.data()) for entry in said("star", "/star/tool")}
    wanted = ("Transform3D:translation", "Transform3D:quaternion")
    rows = judge.table("star", contents, "entry", *(f"/star/tool:{column}" for column in wanted)).to_pylist()
    found = {row["entry"]: [row[f"/star/tool:{column}"] for column in wanted] for row in rows}
    found = {entry: pose for entry, pose in found.items() if pose[0] is not None}
    assert found.keys() == entries.keys()
    places, turns = (np.array([found[entry][part][0] for entry in entries]) for part in (0, 1))
    np.testing.assert_allclose(places, [pose.translation for pose in entries.values()], atol=1e-7)
    np.testing.assert_allclose(turns, [pose.rotation for pose in entries.values()], atol=1e-7)
    assert len(np.unique(places, axis=0)) > 1000


def test_clouds_texts_and_numbers_are_those_of_the_messages(judge: Judge) -> None:
    clouds = [columns(PointCloud2.unpack(entry.data())) for entry in said("star", "/star/cloud")]
    points = judge.table("star", "/star/cloud", "/star/cloud:Points3D:positions").column(0).to_pylist()
    sizes = [int(np.isfinite(sum(fields[axis] for axis in "xyz")).sum()) for fields in clouds]
    assert [len(each) for each in points] == sizes

    texts = [entry for entry in said("star") if entry.type == String.TYPE]
    for topic in {entry.channel for entry in texts}:
        shown = judge.table("star", topic, f"{topic}:TextDocument:text").column(0).to_pylist()
        assert shown == [[String.unpack(entry.data()).data] for entry in texts if entry.channel == topic]

    sensors = [entry for entry in said("every-type") if entry.type == Sensor.TYPE]
    assert sensors
    for topic in {entry.channel for entry in sensors}:
        column = judge.table("every-type", topic, f"{topic}:Scalars:scalars").column(0).to_pylist()
        values = [Sensor.unpack(entry.data()).values.tolist() for entry in sensors if entry.channel == topic]
        assert [each for each in column if each is not None] == [each for each in values if len(each) == len(values[0])]
