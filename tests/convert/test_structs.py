"""Field types of CDR: what does not fit is refused."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert.cdr import CdrReader, CdrWriter
from igtl_gateway.convert.structs import INT16, UINT8, UINT32, CdrType


@pytest.mark.parametrize(
    ("kind", "value"), [(INT16, 32_768), (INT16, -32_769), (UINT8, 256), (UINT32, -1), (UINT8, 0.5)]
)
def test_a_number_that_does_not_fit_its_field_is_refused(kind: CdrType, value: float) -> None:
    with pytest.raises(ConversionError, match=f"found {value}, expected a number that fits {kind.name}"):
        kind.write(CdrWriter(), value)


@pytest.mark.parametrize(("kind", "value"), [(INT16, -32_768), (UINT8, 255), (UINT32, 2**32 - 1)])
def test_the_last_number_that_fits(kind: CdrType, value: int) -> None:
    out = CdrWriter()
    kind.write(out, value)
    assert kind.read(CdrReader(out.finish(), "test")) == value
