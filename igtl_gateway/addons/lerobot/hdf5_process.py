"""The program that reads columns of an HDF5 file of others: libhdf5 may end its process, or take all memory and time.

``python -m igtl_gateway.addons.lerobot.hdf5_process BYTES PATH``: its data may take this number of bytes.  The input is
a line of JSON with the names of datasets.  The output is a line with what each one is, or with what is wrong; after one
more line of input, for each one a line, whether it was read, and its numbers in the order of bytes of this machine.

Only what lies in the file itself is read: hard links, no external or virtual storage, the filters of HDF5 itself.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from itertools import islice
from math import prod
from typing import Any

import numpy as np

from igtl_gateway.addon import one_of
from igtl_gateway.addon.processes import limit_data

#: Names of a group that an error considers, and those that it lists.
_NAMES, _LISTED = 2000, 8
#: Filters that are part of HDF5 and h5py (H5Z_FILTER_…, LZF): gzip, shuffle, fletcher32, szip, nbit, scaleoffset.
_FILTERS = frozenset((1, 2, 3, 4, 5, 6, 32000))
#: Classes of types (H5T_…) beside numbers.
_KINDS = {
    3: "strings", 4: "bit fields", 5: "opaque values", 6: "compound values", 7: "references", 8: "an enumeration",
    9: "lists", 10: "arrays",
}  # fmt: skip


class Unusable(Exception):
    """A dataset that has no columns of numbers: the text has what was found and what was expected."""


def find(file: Any, name: str) -> Any:
    """Return a dataset of an open file by its name.  Raises Unusable."""
    import h5py

    here = file
    for part in filter(None, name.split("/")):
        if not isinstance(here, h5py.Group):
            raise Unusable(f"found a dataset {_shown(here.name)}, expected a group")
        links, own = here.id.links, part.encode()  # the link itself: no other file is opened
        if not links.exists(own):
            raise Unusable(f"found no {part!r}, expected {_names(part, here)}")
        if links.get_info(own).type != h5py.h5l.TYPE_HARD:
            raise Unusable(f"found a link to another place ({part!r}), expected data in the file itself")
        here = here[part]
    if not isinstance(here, h5py.Dataset):
        if isinstance(here, h5py.Group):
            raise Unusable(f"found a group, expected a dataset in it, {_names('', here)}")
        raise Unusable("found a type, expected a dataset")
    return here


def _names(part: str, group: Any) -> str:
    """The names in a group, of which one is meant."""
    return one_of(part, map(_shown, islice(group, _NAMES)), _LISTED)


def _shown(text: object) -> str:
    found = str(text)
    return found if len(found) <= 80 else f"{found[:80]}…"


def describe(dataset: Any) -> dict[str, Any]:
    """Return shape, numbers, bytes in the file and bytes of a chunk of a dataset, without reading it.

    Raises Unusable for anything but rows of integers or floating-point numbers in the file itself.
    """
    import h5py

    kind, dtype = dataset.id.get_type().get_class(), dataset.dtype
    if kind not in (h5py.h5t.INTEGER, h5py.h5t.FLOAT) or dtype.kind not in "iuf" or dtype.itemsize > 8:
        raise Unusable(f"found {_KINDS.get(kind) or _shown(dtype)}, expected numbers of at most 64 bits")
    if not dataset.shape:
        raise Unusable("found a single value, expected rows")
    storage = dataset.id.get_create_plist()
    if dataset.is_virtual or storage.get_external_count():
        raise Unusable("found data in other files, expected them in the file itself")
    filters = [storage.get_filter(number) for number in range(storage.get_nfilters())]
    if other := next((each for each in filters if each[0] not in _FILTERS), None):
        name = _shown(other[3].decode("utf-8", "replace"))
        raise Unusable(f"found filter {other[0]} ({name}), expected one of HDF5, such as gzip")
    return {
        "shape": list(dataset.shape),
        "dtype": dtype.newbyteorder("=").str,
        "packed": dataset.id.get_storage_size(),
        "chunk": prod(dataset.chunks or (0,)) * dtype.itemsize,
    }


def described(file: Any, names: Sequence[str]) -> tuple[list[Any], dict[str, Any]]:
    """Return the datasets of these names, and the first line of the output."""
    datasets, facts = [], []
    for number, name in enumerate(names):
        try:
            datasets.append(find(file, name))
            facts.append(describe(datasets[-1]))
        except Unusable as error:
            return [], {"name": number, "error": str(error)}
        except (KeyError, OSError, RuntimeError, TypeError, ValueError) as error:
            return [], {"name": number, "error": f"found {_reason(error)}, expected a dataset"}
    return datasets, {"datasets": facts}


def _reason(error: BaseException) -> str:
    return _shown(str(error.args[0] if error.args else error).partition("\n")[0])


def _numbers(dataset: Any) -> bytes:
    values = np.empty(dataset.shape, dataset.dtype.newbyteorder("="))
    if values.size:
        dataset.read_direct(values)
    return values.tobytes()


def main() -> None:
    """Answer once."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no reply
    limit_data(int(sys.argv[1]))

    def reply(facts: dict[str, Any]) -> None:
        replies.write(json.dumps(facts).encode() + b"\n")
        replies.flush()

    try:
        import h5py
    except ImportError as error:
        reply({"absent": str(error)})
        return
    with open(0, encoding="utf-8", closefd=False) as lines:
        try:
            with h5py.File(sys.argv[2], "r") as file:
                datasets, facts = described(file, json.loads(lines.readline()))
                reply(facts)
                if datasets and lines.readline():
                    for dataset in datasets:
                        data = _numbers(dataset)
                        reply({})
                        replies.write(data)
        except MemoryError:
            reply({"memory": True})
        except (OSError, RuntimeError, ValueError) as error:
            reply({"error": _reason(error)})


if __name__ == "__main__":
    main()
