"""Numbers of messages by name: as columns and one message at a time, of every type, and beside tables by pyarrow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway.api.columns import HEAD, MAX_NUMBERS
from igtl_gateway.api.field_numbers import FieldReader, numbers_of
from igtl_gateway.api.recording import session_of
from tests.places import FIXTURES


def test_a_number_has_the_name_that_a_person_gives_it() -> None:
    joints = {"header": {"stamp_ns": 5, "seq": 1}, "name": ["elbow", "wrist"], "position": np.array([1.0, 2.0])}
    assert numbers_of(joints | {"effort": [3.0], "is_homed": True, "entry": 4}) == {
        "header.stamp_ns": 5.0,
        "position.elbow": 1.0,
        "position.wrist": 2.0,
        "effort.0": 3.0,
        "is_homed": 1.0,
        "entry_": 4.0,
    }
    assert numbers_of(joints, "position") == {"position.elbow": 1.0, "position.wrist": 2.0}
    assert numbers_of(joints, "position.wrist") == {"position.wrist": 2.0}
    assert numbers_of(joints, "position.1") == {"position.1": 2.0} and numbers_of(joints, "pos") == {}
    tools = {"elements": [{"name": "Stylus", "x_mm": 4.0}, {"name": "", "x_mm": 5.0}], "pixels": bytes(9)}
    assert numbers_of(tools) == {"Stylus.x_mm": 4.0, "elements.1.x_mm": 5.0}
    assert numbers_of(tools, "elements.0.x_mm") == {"elements.0.x_mm": 4.0}


def test_a_long_list_has_the_number_that_is_asked_for() -> None:
    long = {"data": np.arange(MAX_NUMBERS + 1.0), "text": "7", "none": None}
    assert numbers_of(long) == {} and numbers_of(long, "data.64") == {"data.64": 64.0}
    assert numbers_of(long, "data.65") == {} and numbers_of(long, "data.-1") == {} and numbers_of(long, "data") == {}


@pytest.mark.parametrize("name", ["every-type", "crtk", "star"])
def test_columns_have_the_numbers_of_each_message(name: str) -> None:
    by_columns = set()
    with igtl_gateway.open(FIXTURES / f"{name}.mcap") as recording, session_of(recording) as file:
        for key, stream in recording.streams.items():
            reader = FieldReader.of(stream, file.definitions)
            found = reader.of_blocks(stream.blocks())
            payloads = [block.payload(row) for block in stream.blocks() for row in range(len(block))]
            rows = [row for row in (_numbers(reader, payload) for payload in payloads) if row is not None]
            assert len(found.times) == len(rows), (key, found.problem)  # some messages cannot be decoded
            assert {each for row in rows for each in row} >= set(found.fields), key
            for number, row in enumerate(rows):
                assert _finite(row) == _finite({each: values[number] for each, values in found.fields.items()}), key
            block = next(iter(stream.blocks()), None)
            if block is not None and _has_columns(reader, block):
                by_columns.add(stream.type)
            for field, values in list(found.fields.items())[:3]:  # alone, by the same name
                alone = FieldReader.of(stream, file.definitions, field).of_blocks(stream.blocks()).fields[field]
                known = np.isfinite(values)  # a place has its number also where it has a name
                assert np.array_equal(alone[known], values[known]), (key, field)
    assert len(by_columns) > 1, by_columns


def test_tables_have_the_same_numbers() -> None:
    pytest.importorskip("pyarrow", reason="needs pyarrow")
    import pyarrow as pa

    compared = 0
    with igtl_gateway.open(FIXTURES / "every-type.mcap") as recording, session_of(recording) as file:
        for key, stream in recording.streams.items():
            found = FieldReader.of(stream, file.definitions).of_blocks(stream.blocks()).fields
            table = stream.to_arrow()
            for field in table.schema:
                is_number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
                if is_number and field.name not in (*HEAD, "link") and field.name in found:
                    assert _cells(found[field.name].tolist()) == _cells(table[field.name].to_pylist()), (
                        key,
                        field.name,
                    )
                    compared += 1
    assert compared > 200


def test_a_thinned_stream_has_every_third_message() -> None:
    with igtl_gateway.open(FIXTURES / "crtk.mcap") as recording, session_of(recording) as file:
        stream = recording["/PSM1/measured_js"]
        reader = FieldReader.of(stream, file.definitions)
        whole, thin = reader.of_blocks(stream.blocks()), reader.of_blocks(stream.blocks(), 3)
        assert thin.times.tolist() == stream.times[::3].tolist()
        for name, values in whole.fields.items():
            assert np.array_equal(thin.fields[name], values[::3])


def _numbers(reader: FieldReader, payload: memoryview) -> dict[str, float] | None:
    try:
        return reader.numbers(payload)
    except Exception:
        return None


def _has_columns(reader: FieldReader, block: Any) -> bool:
    try:
        return bool(reader._columns(block))
    except Exception:
        return False


def _finite(row: dict[str, float]) -> dict[str, float]:
    return {name: value for name, value in row.items() if math.isfinite(value)}


def _cells(values: list[Any]) -> list[float | None]:
    return [float(value) if value is not None and math.isfinite(value) else None for value in values]
