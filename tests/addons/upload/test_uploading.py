"""Upload: every object equals its file, whatever the store and the process do; keys are in no file."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from igtl_gateway.addons.upload import s3, uploading
from igtl_gateway.addons.upload.live import BridgeUploads
from igtl_gateway.addons.upload.place import UploadPlace, upload_place
from igtl_gateway.addons.upload.uploading import Uploader
from igtl_gateway.base.clock import ManualClock, SystemClock
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.notations import retention
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.retention.retention import Retention
from igtl_gateway.record.retention.upload_state import UploadProtection, UploadState, belongs
from tests.addons.upload.store import Store, running_store
from tests.places import ROOT
from tests.record import samples
from tests.record.test_parts import record, session

PLACE = UploadPlace("bucket", "or1")
SECRET = "s3cr3t/KEY+of=the+store"


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with running_store() as found:
        monkeypatch.setenv("AWS_ENDPOINT_URL", found.url)
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        monkeypatch.delenv("AWS_SESSION_TOKEN", raising=False)
        monkeypatch.setattr(uploading, "PART_BYTES", 10_000)
        monkeypatch.setattr(uploading, "_FIRST_WAIT_S", 0.01)
        monkeypatch.setattr(uploading, "_LAST_WAIT_S", 0.01)
        yield found


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    noise = random.Random(4)
    for name, count in (("small", 1), ("large", 60)):
        entries = [samples.igtl(seq, body=noise.randbytes(1500)) for seq in range(1, count + 1)]
        record(folder / f"{name}.mcap", entries)
    record(folder / "long.mcap", session(3), split_s=1.0)
    return folder


@pytest.fixture
def folder(models: Path, tmp_path: Path) -> Path:
    for path in models.rglob("*.mcap"):
        copy = tmp_path / path.relative_to(models)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(path.read_bytes())
    (tmp_path / "foreign.txt").write_text("not a recording")
    return tmp_path


def upload(folder: Path, *, rate: float = 0.0, attempts: int = 40) -> tuple[list[Note], list[str]]:
    """Upload as far as possible; return the notes, and what is left."""
    notes: list[Note] = []
    uploader = Uploader(folder, None, PLACE, rate, SystemClock(), notes.append)
    for _ in range(attempts):
        if uploader.step() or not uploader.counts.problem:
            break
        time.sleep(0.012)
    left = [each.name for each in uploader.waiting()]
    uploader.close()
    return notes, left


def is_complete(store: Store, folder: Path) -> bool:
    files = {f"or1/{path.relative_to(folder)}": path.read_bytes() for path in folder.rglob("*.mcap")}
    return {key: data for key, (data, _) in store.objects.items()} == files


def test_signatures_are_those_of_the_documentation_of_aws() -> None:
    nothing = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    headers = {
        "host": "examplebucket.s3.amazonaws.com",
        "range": "bytes=0-9",
        "x-amz-content-sha256": nothing,
        "x-amz-date": "20130524T000000Z",
    }
    secret = "wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY"
    found = s3.sign(secret, "20130524T000000Z", "us-east-1", "GET\n/test.txt\n", headers, nothing)
    assert found == "f0e8bdb87c964420e857bd35b5d6ed310bd44f0170aba48dd91039c6036bdb41"


def test_every_recording_is_uploaded_once(store: Store, folder: Path) -> None:
    notes, left = upload(folder)
    assert not left and is_complete(store, folder) and {note.code for note in notes} == {"upload_confirmed"}
    count = store.received
    assert upload(folder) == ([], []) and store.received == count, "a second run sends nothing"
    states = list(folder.glob("*.uploads.jsonl"))
    assert len(states) == 3
    for path in states:
        assert path.stat().st_mode & 0o777 == 0o600 and SECRET not in path.read_text()
        path.unlink()
    assert upload(folder)[1] == [] and store.received == count, "nor after the state is lost"


@pytest.mark.parametrize(("parts", "more"), [(1, 0), (1, 1), (2, 0), (2, 1), (3, 0), (3, 1)])
def test_an_object_of_few_parts_has_the_tag_of_its_parts(
    parts: int, more: int, store: Store, models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One part that is as large as a part may be is sent as a whole, one byte more in two."""
    data = (models / "large.mcap").read_bytes()
    monkeypatch.setattr(uploading, "PART_BYTES", -(-len(data) // parts) + more)
    assert -(-len(data) // uploading.PART_BYTES) == parts
    (tmp_path / "large.mcap").write_bytes(data)
    notes, left = upload(tmp_path)
    assert not left and is_complete(store, tmp_path) and {note.code for note in notes} == {"upload_confirmed"}


@pytest.mark.parametrize(("status", "code"), [(412, "PreconditionFailed"), (404, "NoSuchUpload")])
@pytest.mark.parametrize("is_there", [True, False])
def test_where_an_object_was_made_meanwhile_no_part_is_left(
    status: int, code: str, is_there: bool, store: Store, folder: Path
) -> None:
    """Parts without an object cost money; the answer to an upload that was made before may be lost."""
    answers = 0

    def fault(method: str, path: str, query: dict[str, str]) -> tuple[int, dict[str, str], bytes] | None:
        nonlocal answers
        if method != "POST" or sorted(query) != ["uploadId"] or answers:
            return None
        answers += 1
        if is_there:
            data = (folder / "large.mcap").read_bytes()
            parts = [data[at : at + 10_000] for at in range(0, len(data), 10_000)]
            tags = b"".join(hashlib.md5(part, usedforsecurity=False).digest() for part in parts)
            tag = f'"{hashlib.md5(tags, usedforsecurity=False).hexdigest()}-{len(parts)}"'
            meta = {"etag": tag, "x-amz-meta-sha256": hashlib.sha256(data).hexdigest()}
            store.objects[path.removeprefix("/bucket/")] = data, meta
        return status, {}, f"<Error><Code>{code}</Code></Error>".encode()

    store.fault = fault
    notes, left = upload(folder)
    assert answers == 1 and not left and is_complete(store, folder)
    assert store.uploads == {}, "no parts without an object"
    codes = {note.code for note in notes}
    assert "upload_confirmed" in codes
    if is_there and status == 404:
        assert codes == {"upload_confirmed"}, "what is there is looked at, without an attempt more"


def test_random_faults_of_the_store_end_in_equal_objects(store: Store, folder: Path) -> None:
    chance = random.Random(7)
    answers = [
        (500, {}, b"no"),
        (503, {}, b""),
        (200, {"content-length": "9", "connection": "close"}, b""),
        (301, {"location": "/"}, b""),
    ]

    def fault(method: str, _path: str, query: dict[str, str]) -> tuple[int, dict[str, str], bytes] | None:
        harmful = method == "HEAD" or "uploads" in query  # these accept a status of 200
        return chance.choice(answers[: 2 if harmful else 4]) if chance.random() < 0.3 else None

    store.fault = fault
    notes, left = upload(folder, attempts=400)
    store.fault = lambda _method, _path, _query: None
    notes += upload(folder)[0]
    assert is_complete(store, folder), left
    assert {"upload_waits", "upload_reached", "upload_confirmed"} <= {note.code for note in notes}


def test_an_interrupted_upload_sends_only_what_is_missing(store: Store, folder: Path) -> None:
    size = (folder / "large.mcap").stat().st_size
    parts = -(-size // 10_000)
    assert parts > 6
    store.fault = lambda _method, _path, query: (500, {}, b"") if query.get("partNumber") == "5" else None
    upload(folder, attempts=2)
    store.fault = lambda _method, _path, _query: None
    store.requests.clear()
    assert not upload(folder)[1] and is_complete(store, folder)
    sent = [query["partNumber"] for _, path, query in store.requests if "partNumber" in query and "large" in path]
    assert sent == [str(number) for number in range(5, parts + 1)]


@pytest.mark.parametrize(("status", "goes_on"), [(404, True), (403, False)])
def test_parts_that_the_store_has_forgotten_are_sent_again(
    status: int, goes_on: bool, store: Store, folder: Path
) -> None:
    """A store removes old parts; that it does not let us look is another matter, which is reported."""
    store.fault = lambda _method, _path, query: (500, {}, b"") if query.get("partNumber") == "5" else None
    upload(folder, attempts=2)
    store.uploads.clear()
    store.requests.clear()
    store.fault = lambda method, _path, query: (
        (status, {}, b"<Error><Code>NoSuchUpload</Code></Error>") if method == "GET" and "uploadId" in query else None
    )
    notes, left = upload(folder, attempts=3)
    assert (left == []) is goes_on and is_complete(store, folder) is goes_on
    numbers = [query["partNumber"] for _, path, query in store.requests if "partNumber" in query and "large" in path]
    assert (numbers[:2] == ["1", "2"]) if goes_on else numbers == []
    assert ("upload_waits" in {note.code for note in notes}) is not goes_on


def _denied(_method: str, _path: str, _query: dict[str, str]) -> tuple[int, dict[str, str], bytes]:
    return 403, {}, b"<Error><Code>AccessDenied</Code></Error>"


def _elsewhere(_method: str, _path: str, _query: dict[str, str]) -> tuple[int, dict[str, str], bytes]:
    return 307, {"location": "http://127.0.0.1:1/"}, b""


@pytest.mark.parametrize(("fault", "words"), [(_denied, "access denied"), (_elsewhere, "redirect (307)")])
def test_a_store_that_refuses_is_reported_once(
    store: Store, folder: Path, fault: Callable[..., tuple[int, dict[str, str], bytes]], words: str
) -> None:
    store.fault = fault
    notes, left = upload(folder, attempts=5)
    assert len(left) == 6 and len(notes) == 1 and words in notes[0].text and SECRET not in notes[0].text
    assert (notes[0].level, notes[0].code) == (Level.WARN, "upload_waits")
    assert notes[0].text.startswith("upload waits: ") and notes[0].text.endswith("; the files stay here")


def test_a_step_counts_each_file_and_ends_with_the_last(store: Store, folder: Path) -> None:
    uploader = Uploader(folder, None, PLACE, 0.0, SystemClock(), lambda note: waiting.append(uploader.counts.waiting))
    waiting: list[int] = []
    assert uploader.step(), "nothing waits any more"
    assert waiting == [6, 5, 4, 3, 2, 1]
    assert (uploader.counts.waiting, uploader.counts.waiting_bytes, uploader.counts.confirmed) == (0, 0, 6)
    uploader.close()


@pytest.mark.parametrize("base", ["a", None])
def test_a_recording_is_stated_before_it_has_a_file(base: str | None, store: Store, tmp_path: Path) -> None:
    """So the retention does not delete its first part before it was looked at; ``keep`` begins none."""
    uploader = Uploader(tmp_path, base, PLACE, 0.0, SystemClock(), lambda _note: None)
    uploader.begin()
    uploader.close()
    assert [path.name for path in tmp_path.iterdir()] == (["a.uploads.jsonl"] if base else [])
    if base:
        state = UploadState(tmp_path, base)
        assert state.place == str(PLACE) and store.requests == []


def test_a_part_has_the_size_that_the_documents_state() -> None:
    """S3 takes 5 MiB to 5 GiB, and 10,000 parts."""
    assert uploading.PART_BYTES == 8 * 1024 * 1024
    text = (ROOT / "docs" / "how-to" / "keeping.md").read_text()
    assert "Files above 8 MiB go in parts" in text


def test_the_first_problem_of_the_store_ends_a_step(store: Store, folder: Path) -> None:
    store.fault = _denied
    uploader = Uploader(folder, None, PLACE, 0.0, SystemClock(), lambda _note: None)
    assert not uploader.step()
    assert len({path for _, path, _ in store.requests}) == 1, "the other files wait as well"
    assert (uploader.counts.waiting, uploader.counts.confirmed) == (6, 0) and "access denied" in uploader.counts.problem
    uploader.close()


def test_a_store_that_states_other_bytes_is_not_trusted(store: Store, folder: Path) -> None:
    def fault(method: str, path: str, _query: dict[str, str]) -> tuple[int, dict[str, str], bytes] | None:
        if method != "HEAD" or "small" not in path or "or1/small.mcap" not in store.objects:
            return None
        data, more = store.objects["or1/small.mcap"]
        return 200, more | {"content-length": str(len(data)), "etag": '"' + "0" * 32 + '"'}, b""

    store.fault = fault
    notes, left = upload(folder)
    assert left == ["small.mcap"] and [note.code for note in notes].count("upload_differs") == 1


def test_another_object_is_never_replaced(store: Store, folder: Path) -> None:
    store.objects["or1/small.mcap"] = b"of another program", {"etag": '"0"'}
    notes, left = upload(folder)
    assert left == ["small.mcap"] and store.objects["or1/small.mcap"][0] == b"of another program"
    assert any("another object with this key" in note.text for note in notes)


def test_a_small_file_that_changed_after_it_was_closed_is_not_sent(store: Store, folder: Path) -> None:
    store.fault = lambda method, path, _query: (500, {}, b"") if method == "PUT" and "small" in path else None
    upload(folder, attempts=2)
    store.fault = lambda _method, _path, _query: None
    path = folder / "small.mcap"
    found, data = path.stat(), bytearray(path.read_bytes())
    data[len(data) // 4] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(found.st_mtime_ns, found.st_mtime_ns))  # so that only its bytes show it
    notes, left = upload(folder)
    assert left == ["small.mcap"] and "or1/small.mcap" not in store.objects
    assert any("found other bytes than when it was closed (SHA-256)" in note.text for note in notes)


def test_while_it_waits_a_step_states_whether_a_file_does(
    store: Store, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploading, "_FIRST_WAIT_S", 1_000.0)
    monkeypatch.setattr(uploading, "_LAST_WAIT_S", 1_000.0)
    store.fault = _denied
    uploader = Uploader(folder, None, PLACE, 0.0, SystemClock(), lambda _note: None)
    assert [uploader.step(), uploader.step()] == [False, False]
    for path in folder.rglob("*.mcap"):
        path.unlink()
    asked = len(store.requests)
    assert uploader.step() is True and len(store.requests) == asked == 1
    uploader.close()


def test_a_file_that_changed_after_it_was_closed_is_not_confirmed(store: Store, folder: Path) -> None:
    store.fault = lambda _method, _path, query: (500, {}, b"") if query.get("partNumber") == "3" else None
    upload(folder, attempts=2)
    store.fault = lambda _method, _path, _query: None
    path = folder / "large.mcap"
    found, data = path.stat(), bytearray(path.read_bytes())
    data[25_000] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(found.st_mtime_ns, found.st_mtime_ns))  # so that only its bytes show it
    notes, left = upload(folder)
    assert left == ["large.mcap"] and any("SHA-256" in note.text for note in notes)
    assert "or1/large.mcap" not in store.objects and not store.uploads, "no parts stay in the store"
    os.utime(path)
    notes, left = upload(folder)
    assert left == ["large.mcap"] and "changed after it was closed" in notes[0].text


def test_the_rate_holds(store: Store, folder: Path) -> None:
    size = sum(path.stat().st_size for path in folder.rglob("*.mcap"))
    begun_s = time.monotonic()
    assert not upload(folder, rate=2.0 * size)[1]
    assert time.monotonic() - begun_s > 0.45


def test_retention_keeps_what_the_store_has_not_confirmed(store: Store, folder: Path) -> None:
    protection = UploadProtection(folder, all_files=True)
    how = Retention(folder, retention("1 h"), ManualClock(SystemClock().utc_ns() + 10 * 86_400 * 10**9), protection.why)
    protection.refresh()
    assert not how.preview().deleted and len(how.preview().kept) == 6
    store.fault = lambda _method, path, _query: (500, {}, b"") if "long_1" in path else None
    upload(folder, attempts=3)
    protection.refresh()
    assert {each.recording.name for each in how.preview().kept} >= {"long/long_1.mcap", "long/long_2.mcap"}
    store.fault = lambda _method, _path, _query: None
    upload(folder)
    protection.refresh()
    assert (
        len(how.apply().deleted) == 6
        and not list(folder.glob("*.uploads.jsonl"))
        and is_complete(store, folder) is False
    )


@pytest.mark.slow
def test_a_killed_process_is_started_again_and_continues(store: Store, folder: Path) -> None:
    notes: list[Note] = []
    uploads = BridgeUploads(folder / "long.mcap", PLACE, 20_000.0, notes.append)
    deadline_s = time.monotonic() + 60
    while not store.received and time.monotonic() < deadline_s:
        time.sleep(0.01)
    child = uploads._child
    assert child
    os.kill(child.pid, signal.SIGKILL)
    while len(store.objects) < 4 and time.monotonic() < deadline_s:
        time.sleep(0.02)
    uploads.stop()
    assert set(store.objects) == {f"or1/long/long_{number}.mcap" for number in range(4)}
    assert any("started again" in note.text for note in notes) and "LEFT" not in uploads.left_text()


def test_the_state_survives_a_line_that_was_cut_off(tmp_path: Path) -> None:
    state = UploadState(tmp_path, "a")
    assert state.lock() and not UploadState(tmp_path, "a").lock()
    state.begin(str(PLACE))
    state.set("a.mcap", size=5, modified_ns=7, sha256="x")
    state.close()
    with open(state.path, "ab") as file:
        file.write(b'{"file": "a.mcap", "confir')
    again = UploadState(tmp_path, "a")
    assert again.lock() and again.place == str(PLACE) and again.files["a.mcap"].sha256 == "x"
    again.confirm("a.mcap", 1)
    again.close()
    assert UploadState(tmp_path, "a").files["a.mcap"].confirmed
    assert belongs("a_20260101T000000Z_2.mcap", "a") and belongs("a/a_0.mcap", "a") and not belongs("ab.mcap", "a")


def test_keys_in_the_place_are_refused_and_not_repeated() -> None:
    assert str(upload_place("s3://sessions/or1/a/")) == "s3://sessions/or1/a"
    for text in f"s3://key:{SECRET}@sessions", f"s3://sessions/?sig={SECRET}", f"s3://sessions#{SECRET}":
        with pytest.raises(ConfigError) as error:
            upload_place(text)
        assert SECRET not in str(error.value)
    for text in (
        "http://x",
        "s3://",
        "s3://A",
        "s3://ab",
        "sessions/or1",
        "s3://sessions/a/../b",
        "",
        "s3://sessions/\n",
    ):
        with pytest.raises(ConfigError, match="expected"):
            upload_place(text)


@pytest.mark.slow
def test_the_verb_finishes_what_is_left(store: Store, folder: Path) -> None:
    words = [sys.executable, "-m", "igtl_gateway", "keep", str(folder), "--upload", str(PLACE), "--json"]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    assert done.returncode == 0 and is_complete(store, folder) and '"left": []' in done.stdout
    environment = os.environ | {"AWS_ENDPOINT_URL": "http://store.example"}
    done = subprocess.run(words, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 2 and "expected https://" in done.stderr
