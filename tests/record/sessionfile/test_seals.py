"""Seals in a file: found wherever they lie, each with its own signature; look-alikes are counted."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from igtl_gateway.base.errors import LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.record.seal.envelope import Envelope
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.seal.statement import sign
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.sealing import ENVELOPE_KEY, seal_record
from igtl_gateway.record.sessionfile.seals import Seals, find_seals, has_name_of_seal, stated_seals
from tests.tables import table
from tools import mcap_build as build
from tools.seal_mutations import Original, sealed_file

KEY = SigningKey.generate()
HERE = Path("a.mcap")


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    return sealed_file(tmp_path_factory.mktemp("seals") / "a.mcap", KEY, entries=60, each=20)


def find(data: bytes) -> Seals:
    return find_seals(HERE, io.BytesIO(data), len(data))


def test_seals_are_found_with_their_places_and_digests(original: Original) -> None:
    found = find(original.data)
    assert found.invalid == len(original.seals), "each has a row in the index"
    assert [(seal.at, seal.end, seal.digest) for seal in found.valid] == [
        (unit.at, unit.end, unit.digest) for unit in original.seals
    ]
    assert [seal.statement.checkpoint for seal in found.valid] == list(range(len(original.seals)))
    assert [seal.statement.end_of_file is not None for seal in found.valid][-2:] == [False, True]
    for seal in found.valid:
        assert has_name_of_seal(io.BytesIO(original.data), seal.at)
    assert not has_name_of_seal(io.BytesIO(original.data), original.units[1].at)


def test_they_are_found_where_no_record_can_be_followed(original: Original) -> None:
    first = original.seals[0]
    seal = original.data[first.at : first.end]
    for before in (0, 1, 8, (1 << 20) - 20, (1 << 20) + 5):  # across the pieces that are read
        found = find(b"\xff" * before + seal + b"\xff" * 5 + seal)
        assert [each.at for each in found.valid] == [before, before + len(seal) + 5]


@pytest.mark.parametrize("place", ["length", "name", "signature", "payload"])
def test_a_seal_that_was_changed_is_none(original: Original, place: str) -> None:
    first = original.seals[0]
    at = {"length": 1, "name": 14, "signature": first.size - 20, "payload": 200}[place]
    data = bytearray(original.data[first.at : first.end])
    data[at] ^= 1
    found = find(bytes(data))
    assert found.valid == [] and found.invalid == (place != "name"), "without its name, it is another record"


@table(
    ("record", "invalid"),
    [
        (build.record(build.METADATA, build.metadata(SEAL_METADATA, {})), 1),
        (build.record(build.METADATA, build.metadata(SEAL_METADATA, {ENVELOPE_KEY: "{}"})), 1),
        (seal_record(Envelope(b"{}", KEY.id, b"\0" * 64)), 1),
        (build.record(build.ATTACHMENT, build.attachment(SEAL_METADATA, "", b"")), 1),
        (build.text(SEAL_METADATA), 1),
        (build.record(build.METADATA, build.metadata(SEAL_METADATA, {}), 2**63), 1),
        (build.record(build.METADATA, build.metadata(f"x{SEAL_METADATA}", {})), 0),
        (SEAL_METADATA.encode(), 0),
        (b"", 0),
    ],
)
def test_what_only_has_the_name_is_counted(record: bytes, invalid: int) -> None:
    assert find(record) == Seals([], invalid)


def test_a_seal_that_names_another_key_is_none(original: Original) -> None:
    """Its signature is of this key, the statement in it is not."""
    other = SigningKey.generate()
    statement = find(original.data).valid[0].statement
    assert find(seal_record(sign(statement, other))) == Seals([], 1)
    assert len(find(seal_record(sign(statement, KEY))).valid) == 1


def test_seals_are_bounded(original: Original) -> None:
    count = len(original.seals)
    with limits_in_force(FileLimits(count=count)):
        find(original.data)
    with limits_in_force(FileLimits(count=count - 1)), pytest.raises(LimitExceeded, match=r"a\.mcap: seals: found"):
        find(original.data)


def test_what_a_file_states_of_its_seals(original: Original, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(original.data)
    stated = stated_seals(path)
    assert stated and (stated.keys, stated.seals, stated.closed) == ((KEY.id,), len(original.seals), True)
    path.write_bytes(original.data[: original.seals[-1].at + 50])  # it was not closed
    stated = stated_seals(path)
    assert stated and (stated.seals, stated.closed) == (len(original.seals) - 1, False)


def test_a_file_without_seals_states_none(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(build.assemble([(build.HEADER, build.header())]).finish())
    assert stated_seals(path) is None
