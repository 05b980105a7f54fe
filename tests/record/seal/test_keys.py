"""Keys of seals: who may read them, what a file may be, and which keys a trusted key introduces."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.record.seal import keys
from igtl_gateway.record.seal.keys import SigningKey, load_trusted, trusted_with

EC_KEY = """\
-----BEGIN PRIVATE KEY-----
MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgevZzL1gdAFr88hb2
OF/2NxApJCzGCEDdfSp6VQO30hyhRANCAAQRWz+jn65BtOMvdyHKcvjBeBSDZH2r
1RTwjmYSi9R/zpBnuQ4EiMnCqfMPWiZqB4QdbAd0E7oH50VpuZ1P087G
-----END PRIVATE KEY-----
"""


def _file(path: Path, data: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(data)
    path.chmod(mode)
    return path


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    pem = SigningKey.generate().private_pem()
    assert SigningKey.load(_file(tmp_path / "key", pem)).private_pem() == pem
    for mode in (0o640, 0o604, 0o620, 0o601):
        with pytest.raises(ConfigError, match=f"found mode {mode:04o}, expected 0600"):
            SigningKey.load(_file(tmp_path / "key", pem, mode))


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"", "no private key"), (b"\xff\0", "no private key"), (EC_KEY.encode(), "no private key|another kind")],
)
def test_what_is_no_key_is_refused_in_one_line(tmp_path: Path, data: bytes, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as caught:
        SigningKey.load(_file(tmp_path / "key", data))
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="found no public key"):
        load_trusted([_file(tmp_path / "pub", data)])


def test_a_missing_key_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        SigningKey.load(tmp_path / "none")
    with pytest.raises(ConfigError, match="found a folder"):
        load_trusted([tmp_path])


def test_openssl_reads_both_files(tmp_path: Path) -> None:
    key = SigningKey.generate()
    private, public = _file(tmp_path / "key", key.private_pem()), _file(tmp_path / "pub", key.public_pem())
    derived = subprocess.run(["openssl", "pkey", "-in", private, "-pubout"], capture_output=True, check=True).stdout
    assert derived == key.public_pem()
    assert load_trusted([public]) == {key.public}
    assert load_trusted([_file(tmp_path / "both", key.public_pem() + SigningKey.generate().public_pem())]) > {
        key.public
    }


def test_an_introduction_extends_trust_to_the_next_keys_only() -> None:
    first, stranger = SigningKey.generate(), SigningKey.generate()
    second = first.successor()
    third = second.successor()
    assert trusted_with(frozenset([first.public]), third.introductions) == {first.public, second.public, third.public}
    assert trusted_with(frozenset([second.public]), third.introductions) == {second.public, third.public}
    assert trusted_with(frozenset([stranger.public]), third.introductions) == {stranger.public}
    forged = stranger.introduce(stranger).replace(stranger.id, first.id)
    for written in (forged, third.introductions[0][:-9], "", "{}", "[1]", "\ud800"):
        assert trusted_with(frozenset([first.public]), [written]) == {first.public}


def test_a_private_key_keeps_its_introductions(tmp_path: Path) -> None:
    new = SigningKey.generate().successor()
    loaded = SigningKey.load(_file(tmp_path / "key", new.private_pem()))
    assert loaded.introductions == new.introductions
    assert loaded.public == new.public


def test_a_signature_is_of_one_key_and_one_payload() -> None:
    key = SigningKey.generate()
    signed = key.sign(b"payload")
    assert keys.verifies(signed, key.public)
    assert not keys.verifies(signed, SigningKey.generate().public)
    assert not keys.verifies(type(signed)(b"payloae", signed.key_id, signed.signature), key.public)
    assert not keys.verifies(type(signed)(b"payload", signed.key_id, b""), key.public)
