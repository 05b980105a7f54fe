"""Temporary files of these tests lie in a folder that is deleted: outputs that differ stay until their user goes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def temporary_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A folder for temporary files of this process and of those that it starts; its name is short, for sockets."""
    tmp_path_factory.getbasetemp()  # pytest's own folders stay where they are
    with (
        tempfile.TemporaryDirectory(prefix="resim-", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("TMPDIR", folder)
        patch.setattr(tempfile, "tempdir", folder)
        yield
