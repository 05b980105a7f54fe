"""Parquet tables, and folders of training sets."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from functools import cache
from io import BytesIO
from pathlib import Path
from random import Random

import pyarrow as pa
from pyarrow import parquet

from igtl_gateway.addons.lerobot.checking import check_rules
from igtl_gateway.addons.lerobot.export import export_lerobot
from igtl_gateway.base.untrusted.parquet_file import read_parquet
from igtl_gateway.base.untrusted.text import printable
from tests.addons.lerobot.sessions import Sent, arm, write_session
from tools.kinds.values import Maker

Files = Mapping[str, bytes]
_RECIPE = """\
[dataset]
fps = 10
task = "sew"
format = "{form}"
measure_lags = false
[[feature]]
name = "observation.state"
stream = "TRANSFORM/ArmToBase"
[[feature]]
name = "action"
next_of = "observation.state"
"""
_MAGIC = b"PAR1"
#: Bytes of a footer that are struck, and of the pages before it.
_FOOTER, _PAGES = 1_600, 240


@cache
def _table(packing: str) -> bytes:
    out = BytesIO()
    table = pa.table(
        {
            "n": pa.array(range(12), pa.int64()),
            "x": pa.array([number / 3 for number in range(12)], pa.float32()),
            "s": pa.array(["a", "b"] * 6).dictionary_encode(),
            "l": pa.array([[1.0, 2.0]] * 12, pa.list_(pa.float64())),
        }
    )
    parquet.write_table(table, out, compression=packing, row_group_size=5)
    return out.getvalue()


def table(make: Maker) -> Files:
    """A Parquet file: any word of its footer and of its first pages."""
    return {"a.parquet": _struck(make, "", _table(make.one_of("packing", ("none", "snappy", "zstd"))))}


def _struck(make: Maker, place: str, data: bytes) -> bytes:
    size = int.from_bytes(data[-8:-4], "little")
    begin = len(data) - 8 - size
    pages = make.words(f"{place}pages", data[4:begin], _PAGES)
    footer = make.blob(f"{place}footer", make.words(f"{place}footer", data[begin:-8], _FOOTER))
    length = make.length(f"{place}footer.length", size)
    return _MAGIC + pages + footer + length.to_bytes(4, "little") + _MAGIC


def read_table(path: Path, _rng: Random) -> str:
    """A table, with all its values."""
    read_parquet(path)
    return "read"


@cache
def _sets() -> dict[str, dict[str, bytes]]:
    """Format → name of a file → its bytes, of a small data set."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-set-"))
    try:
        messages: list[Sent] = [(0.1 * n, "TRANSFORM/ArmToBase", arm(0.1 * n, 0)) for n in range(12)]
        path = write_session(folder / "s.mcap", messages)
        found = {}
        for form in ("v2.1", "v3.0"):
            recipe = folder / f"{form}.toml"
            recipe.write_text(_RECIPE.format(form=form), "utf-8")
            export_lerobot(path, recipe, folder / form)
            files = (
                each for each in sorted((folder / form).rglob("*")) if each.is_file() and each.name != "SHA256SUMS"
            )
            found[form] = {str(each.relative_to(folder / form)): each.read_bytes() for each in files}
        return found
    finally:
        shutil.rmtree(folder)


def data_set(make: Maker) -> Files:
    """A folder of a training set: any value of its documents, and any word of its tables."""
    form = make.one_of("form", ("v2.1", "v3.0"))
    return {f"set/{name}": _document(make, f"form.{form}.{name}", data) for name, data in _sets()[form].items()}


def _document(make: Maker, place: str, data: bytes) -> bytes:
    """A file of a data set with its fields."""
    if place.endswith(".json"):
        return make.json(place, json.loads(data)).encode("utf-8", "surrogatepass")
    if place.endswith(".jsonl"):
        rows = [make.json(place, json.loads(line)) for line in data.decode().splitlines()]
        return "\n".join(rows).encode("utf-8", "surrogatepass")
    return _struck(make, f"{place}.", data) if place.endswith(".parquet") else data


def read_data_set(path: Path, _rng: Random) -> str:
    """The check of a data set by the rules of its format."""
    found, findings = check_rules(path)
    printable("\n".join(findings))
    return "refused" if found is None else "read"
