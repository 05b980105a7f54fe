"""COLORT: the grey values or colours that stand for the values of an image (``Protocol/colortable.md``)."""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.buffers import Buffer
from igtl_gateway.base.errors import MalformedBody, TruncatedMessage
from igtl_gateway.base.quantities import counted
from igtl_gateway.base.versions import Self
from igtl_gateway.wire.body import describe_values
from igtl_gateway.wire.layout import Field, Layout, compile_struct
from igtl_gateway.wire.traits import SHORT, Traits

#: Type of the index → entries of the table.
ENTRIES = {3: 256, 5: 65_536}

#: Type of an entry → numpy type and values of each: u8, u16 (big-endian), RGB.
MAP_U8, MAP_U16, MAP_RGB = 3, 5, 19
MAPS = {MAP_U8: ("u1", 1), MAP_U16: (">u2", 1), MAP_RGB: ("u1", 3)}


@dataclass(frozen=True, slots=True)
class ColorTable:
    """COLORT: a colour table: the grey value or colour of each pixel value.

    Attributes:
        index_type: 3 u8 (256 entries), 5 u16 (65,536 entries).
        map_type: of an entry: 3 u8, 5 u16, 19 RGB (three u8).
        table: the entries, big-endian.
    """

    PROTOCOL: ClassVar[str] = "2"
    TRAITS: ClassVar[Traits] = Traits(SHORT, is_bulky=True)
    LAYOUT: ClassVar[Layout] = (Field("index_type", "u8"), Field("map_type", "u8"), Field("table", "bytes", "the rest"))
    _HEAD: ClassVar[Struct] = compile_struct(LAYOUT)

    index_type: int
    map_type: int
    table: Buffer

    @classmethod
    def unpack(cls, content: memoryview) -> Self:
        if content.nbytes < cls._HEAD.size:
            raise TruncatedMessage(
                "COLORT content", counted(content.nbytes, "byte"), f"at least {cls._HEAD.size} bytes"
            )
        index_type, map_type = cls._HEAD.unpack_from(content)
        table = cls(index_type, map_type, content[cls._HEAD.size :])
        table.check()
        return table

    def check(self) -> None:
        """Raises MalformedBody where the types do not exist or the table is not of their size."""
        for place, found, known in (
            ("offset 0, index type", self.index_type, sorted(ENTRIES)),
            ("offset 1, map type", self.map_type, sorted(MAPS)),
        ):
            if found not in known:
                raise MalformedBody(f"COLORT content, {place}", found, f"one of {known}")
        size = memoryview(self.table).nbytes
        dtype, values = MAPS[self.map_type]
        expected = ENTRIES[self.index_type] * values * np.dtype(dtype).itemsize
        if size != expected:
            raise MalformedBody("COLORT table", counted(size, "byte"), counted(expected, "byte"))

    def pack(self) -> list[Buffer]:
        self.check()
        return [self._HEAD.pack(self.index_type, self.map_type), self.table]

    @property
    def array(self) -> npt.NDArray[Any]:
        """The entries as a view: (n,), or (n, 3) for RGB."""
        dtype, values = MAPS[self.map_type]
        flat = np.frombuffer(self.table, dtype)
        return flat.reshape(-1, values) if values > 1 else flat

    def describe(self) -> dict[str, Any]:
        return {
            "index_type": self.index_type,
            "map_type": self.map_type,
            "table": describe_values(self.array.reshape(-1)),
        }
