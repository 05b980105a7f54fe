"""Every export of every golden recording: declared = written + left out, and others count what was written."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML

from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.selection import IGTL_KINDS
from igtl_gateway.addons.exchange.surface_out import export_surface_of
from igtl_gateway.addons.exchange.targets import TARGETS, export_to
from igtl_gateway.base.errors import ConversionError, UnsupportedRecording, WireError
from igtl_gateway.cli import FAILURE, USAGE
from igtl_gateway.convert.clouds import colour_field
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.wire.polydata import CELL, Attribute, PolyData
from tests.addons.exchange import mutants
from tests.addons.exchange.judges import Shape, by_meshio, by_vtk, entries_of_tables, messages_in
from tests.places import FIXTURES
from tests.tables import table
from tests.test_fixtures import NAMES

#: Recordings with several IMAGE streams: of which one a sequence is made.
SEQUENCES = {"every-type": ("Slice@1", "TRANSFORM/*"), "paper-types": ("Grey", "TRANSFORM/*")}
Export = Callable[[str, str], tuple[Path, ExportAccount]]


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """Exports a golden recording, each once."""
    made: dict[tuple[str, str], tuple[Path, ExportAccount]] = {}

    def export(name: str, to: str) -> tuple[Path, ExportAccount]:
        if (name, to) not in made:
            out = tmp_path_factory.mktemp(f"{name}-{to}") / "out"
            globs = SEQUENCES.get(name, ()) if to in ("igs.mha", "seq.nrrd") else ()
            with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
                try:
                    made[name, to] = out, export_to(to, file, out, globs)
                except UnsupportedRecording as error:
                    pytest.skip(str(error))
        return made[name, to]

    return export


@pytest.fixture(scope="session")
def entries() -> Callable[[str], dict[int, Entry]]:
    """The entries of a golden recording by their numbers."""
    read: dict[str, dict[int, Entry]] = {}

    def of(name: str) -> dict[int, Entry]:
        if name not in read:
            with SessionFile.open(FIXTURES / f"{name}.mcap") as file:
                read[name] = {entry.seq: entry for entry in file.entries()}
        return read[name]

    return of


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("to", TARGETS)
def test_declared_is_written_and_left_out(exported: Export, name: str, to: str) -> None:
    _, account = exported(name, to)
    for row in [*account.rows, *account.parts]:
        assert row.declared == row.taken + row.left_out, row
        assert sum(row.reasons.values()) == row.left_out, row
        assert bool(row.why) == bool(row.left_out), row
    if to not in ("igs.mha", "seq.nrrd") or name not in SEQUENCES:  # all streams were asked for
        counted = sum(row.declared for row in account.rows) + sum(account.others.values())
        assert counted == messages_in(FIXTURES / f"{name}.mcap")


@table("name", NAMES)
def test_tables_hold_what_the_account_says(exported: Export, entries: Any, name: str) -> None:
    folder, account = exported(name, "csv")
    found: Counter[tuple[str, str]] = Counter()
    for number in entries_of_tables(folder):
        found[entries(name)[number].channel, entries(name)[number].type] += 1
    told: Counter[tuple[str, str]] = Counter()
    for row in account.rows:
        told[row.stream, row.type] += row.taken
    assert found == +told
    assert len(list(folder.iterdir())) == account.files


@pytest.mark.parametrize("name", NAMES)
def test_bags_hold_what_the_account_says(exported: Export, name: str) -> None:
    folder, account = exported(name, "rosbag2")
    told = Counter[str]()
    for row in account.rows:
        told[row.stream] += row.taken
    with Reader(folder) as reader:
        stores = {one.msgtype: get_typestore(Stores.EMPTY) for one in reader.connections}
        for one in reader.connections:
            stores[one.msgtype].register(get_types_from_msg(one.msgdef.data, one.msgtype))
        by_rosbags = Counter[str]()
        for one, _, data in reader.messages():
            stores[one.msgtype].deserialize_cdr(data, one.msgtype)
            by_rosbags[one.topic] += 1
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as stream:
        channels = make_reader(stream, validate_crcs=True).get_summary().channels.values()  # type: ignore[union-attr]
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        by_mcap = Counter(channel.topic for _, channel, _, _ in decoded)
    side = YAML(typ="safe").load(folder / "metadata.yaml")["rosbag2_bagfile_information"]
    topics = side["topics_with_message_count"]
    assert by_rosbags == by_mcap == told
    assert {one["topic_metadata"]["name"]: one["message_count"] for one in topics} == told
    assert side["message_count"] == told.total()
    formats = {one["topic_metadata"]["serialization_format"] for one in topics}
    assert formats == {channel.message_encoding for channel in channels} == {"cdr"}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("to", ["vtk", "ply"])
def test_surfaces_are_read_by_others(exported: Export, entries: Any, name: str, to: str) -> None:
    folder, account = exported(name, to)
    if not any(row.taken for row in account.rows):
        pytest.skip("no surface")
    files = sorted(folder.iterdir())
    assert len(files) == account.files == sum(row.taken for row in account.rows)
    found = [by_vtk(path) for path in files]
    for shape in found if to == "vtk" else ():  # the bytes of colours, which are a field, too
        for arrays in (shape.of_points, shape.of_cells):
            assert arrays.pop("colours", np.zeros(0, np.uint8)).dtype == np.uint8
    assert {shape.title for shape in found} == {"igtl-gateway, millimetres, SPACE=RAS"}
    told = Counter[str]()
    for part in account.parts:
        told[part.unit] += part.taken
    assert sum(len(shape.points) for shape in found) == told["points"]
    units = ("vertex cells", "lines", "polygons", "triangle strips")
    assert sum(len(shape.cells) for shape in found) == sum(told[unit] for unit in units)
    contents = surfaces(entries(name).values())
    for path, shape in zip(files, found, strict=True):
        assert any(is_same(shape, content, to) for content in contents), path
        if to == "ply":
            other = by_meshio(path)
            assert np.array_equal(other.points, shape.points)
            assert sorted(other.cells) == sorted(shape.cells)
            assert np.array_equal(other.of_points.get("red", []), first_column(shape, "RGB"))
            assert np.array_equal(other.of_points.get("nx", []), first_column(shape, "Normals"))
    if to == "vtk":
        assert sum(len(shape.of_points) + len(shape.of_cells) for shape in found) == told["attributes"]


@table("name", NAMES)
def test_volumes_are_read_by_others(exported: Export, name: str) -> None:
    nrrd = pytest.importorskip("nrrd")
    folder, account = exported(name, "nrrd")
    files = sorted(folder.iterdir()) if account.files else []
    assert len(files) == account.files == sum(row.taken for row in account.rows)
    for path in files:
        pixels, head = nrrd.read(str(path))
        assert list(pixels.shape) == list(head["sizes"])
        assert pixels.nbytes > 0


def first_column(shape: Shape, name: str) -> Any:
    return next((values[:, 0] for key, values in shape.of_points.items() if key.startswith(name)), [])


def surfaces(log: Iterable[Entry]) -> list[PolyData]:
    """What the session has of surfaces and clouds, in millimetres."""
    found = []
    for entry in log:
        with suppress(WireError, ConversionError):
            found.append(export_surface_of(entry, "mm" if entry.kind in IGTL_KINDS else "m").content)
    return found


def is_same(shape: Shape, content: PolyData, to: str) -> bool:
    """Whether a reader found all that the format keeps of a message, and nothing else."""
    cells = [content.polygons] if to == "ply" else content.cells
    if not np.array_equal(shape.points, content.points) or shape.cells != [
        cell for section in cells for cell in section.lists()
    ]:
        return False
    count = sum(section.count for section in content.cells)
    if to == "vtk":
        of_points = {one.name: one.values for one in content.attributes if is_of(one, 0, len(content.points))}
        of_cells = {one.name: one.values for one in content.attributes if is_of(one, CELL, count)}
        return are_same(shape.of_points, of_points) and are_same(shape.of_cells, of_cells)
    colours = [one.values for one in content.attributes if is_of(one, 0, len(content.points)) and colour_field(one)]
    found = [values for name, values in shape.of_points.items() if name.startswith("RGB")]
    return len(found) == len(colours[:1]) and all(
        np.array_equal(one, np.rint(other.astype(np.float64) * 255)) for one, other in zip(found, colours, strict=False)
    )


def is_of(attribute: Attribute, kind: int, count: int) -> bool:
    return attribute.type & CELL == kind and attribute.tuples == count > 0


def are_same(found: dict[str, Any], expected: dict[str, Any]) -> bool:
    return found.keys() == expected.keys() and all(np.array_equal(found[name], expected[name]) for name in found)


@table("to", TARGETS)
def test_flipped_bits_cost_their_own_messages(to: str) -> None:
    for name, data in islice(mutants.mutants(7), 10):
        outcome = mutants.export(data, to, "--json")
        assert outcome.code in (0, FAILURE, USAGE), name
        if outcome.printed.startswith("{"):
            account = json.loads(outcome.printed)
            for row in [*account["rows"], *account["parts"]]:
                assert row["found"] == row["exported"] + row["left_out"], (name, row)
