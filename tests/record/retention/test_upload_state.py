"""Receipts: only what was added is read again, and nothing in one makes an upload send other bytes or end."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from igtl_gateway.addons.upload import s3
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.record.retention.upload_state import SUFFIX, UploadState, UploadStates, remove_finished
from tests.addons.upload import test_uploading
from tests.addons.upload.store import Store

#: Fixtures of the tests of the upload.
store, models, folder = test_uploading.store, test_uploading.models, test_uploading.folder


def _line(**facts: object) -> bytes:
    return json.dumps(facts).encode() + b"\n"


def test_only_what_was_added_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, read = tmp_path / f"a{SUFFIX}", 0

    def counted(text: str, place: str) -> object:
        nonlocal read
        read += 1
        return parse_json(text, place)

    monkeypatch.setattr("igtl_gateway.record.retention.upload_state.parse_json", counted)
    path.write_bytes(_line(to="s3://b/p") + _line(file="a.mcap", size=4) * 1000)
    states = UploadStates(tmp_path)
    for _ in range(5):
        assert [state.files["a.mcap"].size for state in states.now()] == [4]
    assert read == 1001
    with path.open("ab") as file:
        file.write(_line(file="a.mcap", sha256="00") + b'{"file": "a.mcap", "confirmed": "no')  # a crash
    assert [(each.sha256, each.size, each.confirmed) for each in states.now()[0].files.values()] == [("00", 4, "")]
    assert read == 1002
    other = UploadState(tmp_path, "a")
    assert other.lock() and not UploadState(tmp_path, "a").lock()
    other.set("a.mcap", confirmed="now")
    other.close()
    assert states.now()[0].files["a.mcap"].confirmed == "now"
    path.unlink()
    path.write_bytes(_line(to="s3://other"))  # another file of this name
    assert [(state.place, state.files) for state in states.now()] == [("s3://other", {})]
    path.unlink()
    assert states.now() == []


@pytest.mark.parametrize("part_bytes", [0, -1, 1, 1 << 80, "8", None])
def test_other_parts_than_ours_are_not_used(store: Store, folder: Path, part_bytes: object) -> None:
    test_uploading.upload(folder)
    store.objects.clear()
    for path in folder.glob(f"*{SUFFIX}"):
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        path.write_bytes(b"".join(_line(**row | {"part_bytes": part_bytes}) for row in rows if "confirmed" not in row))
    assert test_uploading.upload(folder)[1] == []
    assert test_uploading.is_complete(store, folder)


def test_a_name_that_no_object_can_have_is_named(store: Store, folder: Path) -> None:
    os.rename(os.fsencode(folder / "small.mcap"), os.fsencode(folder) + b"/\xff.mcap")
    notes, left = test_uploading.upload(folder)
    assert left == ["\udcff.mcap"]
    assert ["invalid UTF-8" in note.text for note in notes if note.code == "upload_differs"] == [True]


def test_files_of_aws_are_ordinary_files_with_plain_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "credentials"
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(path))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    os.mkfifo(path)
    with pytest.raises(s3.StoreError, match="found no keys"):
        s3._keys()
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(s3.StoreError, match="found no keys"):
        s3._keys()
    path.unlink()
    for secret, text in (("b\x1b[2J", "control characters"), ("b", "")):
        path.write_text(f"[default]\naws_access_key_id = a\naws_secret_access_key = {secret}\n")
        if text:
            with pytest.raises(s3.StoreError, match=text) as found:
                s3._keys()
            assert secret not in str(found.value)
        else:
            assert s3._keys().secret == secret


def test_a_state_goes_with_the_last_file_of_its_recording(tmp_path: Path) -> None:
    """One without files stays: its recording may just have begun.  One that is in use stays, too."""
    for base, names in (("gone", ["gone.mcap"]), ("there", ["there.mcap"]), ("new", []), ("used", ["used.mcap"])):
        state = UploadState(tmp_path, base)
        assert state.lock()
        state.begin("s3://bucket")
        for name in names:
            state.set(name, upload="1")
        state.close()
    used = UploadState(tmp_path, "used")
    assert used.lock()
    remove_finished(tmp_path, {"there.mcap", "other.mcap"})
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{base}{SUFFIX}" for base in ("new", "there", "used")]
    used.close()
    remove_finished(tmp_path, set())
    assert [path.name for path in tmp_path.iterdir()] == [f"new{SUFFIX}"]
