"""Lines from arrays: the compiled function against its twin and against csv.writer."""

from __future__ import annotations

import csv
import importlib.util
import io
import math
import struct
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.api import csv_lines

compiled: Any = pytest.importorskip("igtl_gateway.native._lines", reason="installed without the C part")


def _python() -> ModuleType:
    """The module as it is without the C part."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "igtl_gateway.native._lines", None)
        spec = importlib.util.find_spec(csv_lines.__name__)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return module


PYTHON = _python()
#: Any 64 bits, so that many are subnormal, infinite or no numbers.
FLOATS = st.one_of(
    st.floats(), st.integers(0, (1 << 64) - 1).map(lambda bits: struct.unpack("<d", struct.pack("<Q", bits))[0])
)


@given(
    floats=st.lists(FLOATS, max_size=6),
    integers=st.lists(st.integers(-(1 << 63), (1 << 63) - 1), min_size=6, max_size=6),
    naturals=st.lists(st.integers(0, (1 << 64) - 1), min_size=6, max_size=6),
    texts=st.lists(st.text(max_size=5), min_size=6, max_size=6),
    mask=st.lists(st.booleans(), min_size=6, max_size=6),
)
def test_lines_are_those_of_the_csv_writer(
    floats: list[float], integers: list[int], naturals: list[int], texts: list[str], mask: list[bool]
) -> None:
    count = len(floats)
    texts = [text.encode("utf-8", "ignore").decode() for text in texts]
    cells: list[csv_lines.Cell] = [
        csv_lines.number_cell(np.array(integers[:count], np.int64)),
        csv_lines.number_cell(np.array(floats, np.float64)),
        csv_lines.number_cell(np.array(naturals[:count], np.uint64), np.array(mask[:count], np.bool_)),
        csv_lines.cell_text("=a,b"),
        [csv_lines.cell_text(text) for text in texts[:count]],
        csv_lines.number_cell(np.array(mask[:count], np.bool_)),
    ]
    stream = io.StringIO()
    writer = csv.writer(stream)
    for row in range(count):
        natural = naturals[row] if mask[row] else ""
        writer.writerow((integers[row], floats[row], natural, "=a,b", texts[row], mask[row]))
    expected = stream.getvalue().encode()
    assert compiled.csv_lines(count, cells) == PYTHON.csv_lines(count, cells) == expected
    for rows in (slice(1), slice(1, count)):
        some = [csv_lines.rows_of_cell(cell, rows) for cell in cells]
        number = len(floats[rows])
        assert compiled.csv_lines(number, some) == PYTHON.csv_lines(number, some)


def test_numbers_of_any_size_are_those_of_python() -> None:
    numbers = [
        *(math.ldexp(1.0, power) for power in range(-1074, 1024)),
        *(float(f"1e{power}") for power in range(-323, 309)),
        *(math.nextafter(10.0**power, 0.0) for power in range(1, 23)),
    ]
    found = compiled.csv_lines(len(numbers), [csv_lines.number_cell(np.array(numbers))])
    assert found.decode().split() == [repr(number) for number in numbers]
    for dtype in ("f4", "u1", "i2", "u4", ">f4"):
        values = np.arange(5).astype(dtype)
        assert compiled.csv_lines(5, [csv_lines.number_cell(values)]).decode().split() == list(
            map(str, values.tolist())
        )


def test_cells_of_another_number_are_refused() -> None:
    for cell in ([b"a"], ("f", np.zeros(3), None), ("f", np.zeros(2), np.ones(1, np.bool_)), ("x", np.zeros(2), None)):
        for module in (compiled, PYTHON):
            with pytest.raises(ValueError, match="csv_lines"):
                module.csv_lines(2, [cell])
    assert compiled.csv_lines(2, []) == PYTHON.csv_lines(2, []) == b"\r\n\r\n"
