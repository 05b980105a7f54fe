"""Recordings of all versions: each file of ``tests/data/versions`` is read and verified by this one.

A version that changes the file, or what is in it, adds a file of its own, ``VERSION-formatNUMBER-KIND.mcap``; none is
ever written again.  ``slice`` is that of ``igtl-gateway slice fixtures/paper-types.mcap --end 0.4``, ``bridge-DATE``
what the bridge of a commit of DATE recorded of a peer that sent ten poses and ten strings; ``digest`` has three
pictures of a peer, and the digests of what the gateway made of them.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.app.verification import verify_recording
from igtl_gateway.base.version import __version__
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.record.sessionfile.layout import PRESENT_VERSIONS
from igtl_gateway.record.sessionfile.reader import SessionFile
from tests.places import ROOT

FILES = sorted((ROOT / "tests" / "data" / "versions").glob("*.mcap"))
#: What came from peers, by the kind of file.
MESSAGES = {"slice": 4, "bridge": 20, "digest": 3}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_of_each_version_is_read_and_verified(path: Path) -> None:
    with SessionFile.open(path) as file:
        assert sum(entry.kind is Kind.IGTL_IN for entry in file.entries()) == MESSAGES[path.stem.split("-")[2]]
    result = verify_recording(path)
    assert result.good and result.outputs == result.equal > 0


def test_this_version_has_a_file() -> None:
    for version in PRESENT_VERSIONS:
        assert [path for path in FILES if path.name.startswith(f"{__version__}-format{version}-")]
