"""Messages of the ROS 2 distributions: equal types and equal bytes in Humble, Jazzy, Kilted and Lyrical.

The definitions of each distribution are those of rosbags.  Where all parts of a type are equal, its hash is.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.convert.interfaces import PACKAGES, interface_files
from tests.places import FIXTURES

NEWER = ("JAZZY", "KILTED", "LYRICAL")
STORES = {name: get_typestore(Stores[f"ROS2_{name}"]) for name in ("HUMBLE", *NEWER)}
OURS = {
    name: fields
    for package in PACKAGES
    for path in interface_files(package)
    if path.suffix == ".msg"
    for name, fields in get_types_from_msg(path.read_text("utf-8"), f"{package}/msg/{path.stem}").items()
}
for store in STORES.values():
    store.register({name: fields for name, fields in OURS.items() if name not in store.fielddefs})


def messages() -> Iterator[tuple[str, bytes]]:
    """Yield the type and the CDR of each ROS message of the recording with all types."""
    with (FIXTURES / "every-type.mcap").open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages():
            if schema is not None and schema.encoding == "ros2msg":
                yield schema.name, message.data


@pytest.fixture(scope="module")
def samples() -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for name, data in messages():
        found.setdefault(name, []).append(data)
    return found


def test_all_types_are_those_of_humble(samples: dict[str, list[bytes]]) -> None:
    assert len(samples) > 40
    hashes = {name: {key: store.hash_rihs01(key) for key in samples} for name, store in STORES.items()}
    assert hashes == dict.fromkeys(STORES, hashes["HUMBLE"])


@pytest.mark.parametrize("newer", NEWER)
def test_humble_and_a_newer_one_read_and_write_equal_bytes(samples: dict[str, list[bytes]], newer: str) -> None:
    humble, other = STORES["HUMBLE"], STORES[newer]
    for name, found in samples.items():
        for data in found:
            read = humble.deserialize_cdr(data, name)
            again = bytes(humble.serialize_cdr(read, name))
            assert again == bytes(other.serialize_cdr(other.deserialize_cdr(data, name), name)), name
            assert again == bytes(other.serialize_cdr(other.deserialize_cdr(again, name), name)), name
