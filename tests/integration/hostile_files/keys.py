"""Hostile keys, seals, profiles of de-identification, and recipes of training sets."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from igtl_gateway.record.seal import envelope, statement
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile.layout import SEAL_METADATA
from igtl_gateway.record.sessionfile.sealing import ENVELOPE_KEY
from tests.integration.hostile_files.case import MIB, NAUGHTY, Danger, Hostile, file
from tests.integration.hostile_files.sessions import Parts, changed
from tools import mcap_build as build

_PEM = serialization.Encoding.PEM
_DEEP = "[" * 100_000 + "]" * 100_000


def _private(data: Callable[[], bytes]) -> Callable[[Path], Path]:
    """A builder of one file with these bytes that only its owner can read, so that it is read as a private key."""

    def build_file(folder: Path) -> Path:
        path = file("hostile.key", data)(folder)
        path.chmod(0o600)
        return path

    return build_file


@cache
def _key() -> SigningKey:
    return SigningKey.generate()


def _other_kind() -> bytes:
    key = ec.generate_private_key(ec.SECP256R1())
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())


def _locked() -> bytes:
    key = ed25519.Ed25519PrivateKey.generate()
    return key.private_bytes(_PEM, serialization.PrivateFormat.PKCS8, serialization.BestAvailableEncryption(b"secret"))


def _block(body: str, name: str = "PUBLIC KEY") -> bytes:
    return f"-----BEGIN {name}-----\n{body}\n-----END {name}-----\n".encode()


_KEYS: tuple[tuple[str, Danger, str, Callable[[], bytes]], ...] = (
    ("empty", Danger.LIE, "nothing", lambda: b""),
    ("short", Danger.LIE, "five bytes", lambda: b"12345"),
    ("zeros", Danger.BOMB, "64 MiB of zeros", lambda: bytes(64 * MIB)),
    ("blocks", Danger.BOMB, "20,000 public keys", lambda: _key().public_pem() * 20_000),
    ("opened", Danger.LIE, "100,000 blocks that do not end", lambda: b"-----BEGIN PUBLIC KEY-----\n" * 100_000),
    ("curve", Danger.SHAPE, "a key of another curve", _other_kind),
    ("locked", Danger.SHAPE, "a key with a password", _locked),
    ("der", Danger.SHAPE, "a block that is not a key", lambda: _block(base64.b64encode(b"\x30\x82\xff\xff").decode())),
    ("text", Danger.TERMINAL, "escape sequences", lambda: _block(NAUGHTY) + _block(NAUGHTY, f"X{NAUGHTY}")),
    (
        "introductions",
        Danger.BOMB,
        "a private key with 50,000 introductions, one of them nested 50,000 deep",
        lambda: _key().private_pem() + (b"{" + b'"a":{' * 50_000 + b"\n") + b'{"a": 1}\n' * 50_000,
    ),
)


def _seal(change: Callable[[dict[str, Any]], Any]) -> Callable[[], bytes]:
    """A session with a seal whose statement was changed and is signed, so that all its signatures are right."""

    def plant(parts: Parts) -> None:
        empty = statement.Statement(
            "a", statement.PartPlace("0" * 32), 0, 0, 0, statement.NO_HEAD, statement.NO_HEAD, (), 1, _key().public
        )
        document = json.loads(statement.sign(empty, _key()).payload)
        change(document["predicate"])
        found = _key().sign(json.dumps(document).encode())
        parts.append((build.METADATA, build.metadata(SEAL_METADATA, {ENVELOPE_KEY: envelope.pack(found)})))

    return changed(plant)


def _written(text: str) -> Callable[[], bytes]:
    """A session with a seal whose envelope is this text."""

    def plant(parts: Parts) -> None:
        parts.append((build.METADATA, build.metadata(SEAL_METADATA, {ENVELOPE_KEY: text})))

    return changed(plant)


_HUGE = 1 << 62
_UNIT = ["chunk", 1, "0" * 64, -1, -1]
_SEALS: tuple[tuple[str, Danger, str, Callable[[], bytes]], ...] = (
    ("empty", Danger.SHAPE, "a seal of nothing", _seal(lambda given: None)),
    (
        "end",
        Danger.LIE,
        "a seal whose end is behind the file",
        _seal(lambda given: given.update(start=_HUGE, end=_HUGE)),
    ),
    (
        "unit",
        Danger.LIE,
        "a seal of a unit of 2^62 bytes",
        _seal(lambda given: given.update(end=_HUGE, units=[["chunk", _HUGE, "0" * 64, -1, -1]])),
    ),
    (
        "units",
        Danger.BOMB,
        "a seal of 100,000 units",
        _seal(lambda given: given.update(end=100_000, units=[_UNIT] * 100_000)),
    ),
    (
        "introductions",
        Danger.BOMB,
        "a seal whose key has 50,000 introductions",
        _seal(lambda given: given.update(introductions=['{"payload": ""}'] * 50_000)),
    ),
    (
        "recording",
        Danger.TERMINAL,
        "a recording with a hostile name",
        _seal(lambda given: given.update(recording=NAUGHTY)),
    ),
    (
        "kind",
        Danger.TERMINAL,
        "a unit with a hostile kind",
        _seal(lambda given: given.update(end=1, units=[[NAUGHTY, *_UNIT[1:]]])),
    ),
    ("time", Danger.LIE, "a seal of the year 10^9", _seal(lambda given: given.update(time_ns=1 << 90))),
    ("deep", Danger.BOMB, "an envelope that is nested 100,000 deep", _written(_DEEP)),
    ("list", Danger.SHAPE, "an envelope that is a list", _written("[1, 2]")),
    ("naughty", Danger.TERMINAL, "an envelope of escape sequences", _written(NAUGHTY)),
    (
        "payload",
        Danger.SHAPE,
        "an envelope without base64",
        _written(
            json.dumps({"payload": "?", "payloadType": envelope.PAYLOAD_TYPE, "signatures": [{"keyid": "", "sig": ""}]})
        ),
    ),
)

_PROFILES: Mapping[str, tuple[Danger, str]] = {
    "deep": (Danger.BOMB, "a = " + _DEEP),
    "masks": (Danger.BOMB, '[[mask]]\nstream = "**"\nrectangles = [[0, 0, 9, 9]]\n' * 20_000),
    "groups": (Danger.BOMB, f'[[text]]\nstream = "**"\naction = "pattern"\npattern = "{"(" * 5000 + ")" * 5000}"\n'),
    "repeats": (Danger.BOMB, '[[text]]\nstream = "**"\naction = "pattern"\npattern = "a{999999999999}"\n'),
    "backtracking": (Danger.BOMB, '[[text]]\nstream = "**"\naction = "pattern"\npattern = "(.|.)*\\u0001"\n'),
    "rectangle": (Danger.LIE, '[[mask]]\nstream = "**"\nrectangles = [[-9, 0, 9, 9]]\n'),
    "huge": (Danger.LIE, '[[mask]]\nstream = "**"\nrectangles = [[0, 0, 999999999999999999999999, 1]]\n'),
    "infinite": (Danger.LIE, '[[mask]]\nstream = "**"\nfan = [0, 0, 0, inf, 0, nan]\n'),
    "names": (Danger.SHAPE, "names = 3\n"),
    "name": (Danger.SHAPE, "[names]\na = [1]\n"),
    "keep": (Danger.SHAPE, "[keep]\nnames = [[1]]\n"),
    "mask": (Danger.SHAPE, '[[mask]]\nstream = 4\nrectangles = "a"\n'),
    "value": (Danger.SHAPE, '[[mask]]\nstream = "**"\nrectangles = [[0, 0, 9, 9]]\nvalue = "a"\n'),
    "text": (Danger.TERMINAL, f"[names]\n{json.dumps(NAUGHTY)} = {json.dumps(NAUGHTY)}\n"),
    "unknown": (Danger.TERMINAL, f"{json.dumps(NAUGHTY)} = 1\n"),
}
_FEATURE = '[[feature]]\nname = "observation.state"\nstream = "TRANSFORM/Probe**"\n'
_SET = '[dataset]\nfps = 20\ntask = "none"\nrobot_type = "none"\n'
_RECIPES: Mapping[str, tuple[Danger, str]] = {
    "deep": (Danger.BOMB, "a = " + _DEEP),
    "features": (Danger.BOMB, _SET + _FEATURE * 20_000),
    "fps": (Danger.BOMB, _SET.replace("20", "1000000000") + _FEATURE),
    "fps-zero": (Danger.LIE, _SET.replace("20", "0") + _FEATURE),
    "fps-nan": (Danger.LIE, _SET.replace("20", "nan") + _FEATURE),
    "list": (Danger.SHAPE, 'dataset = [1]\nfeature = "a"\n'),
    "name": (Danger.SHAPE, _SET + '[[feature]]\nname = 3\nstream = ["a"]\n'),
    "path": (Danger.LIE, _SET + _FEATURE.replace("observation.state", "observation.images.../../../a")),
    "stream": (Danger.TERMINAL, _SET + f'[[feature]]\nname = "action"\nstream = {json.dumps(NAUGHTY)}\n'),
    "task": (Danger.TERMINAL, _SET.replace('"none"', json.dumps(NAUGHTY)) + _FEATURE),
}

CASES: tuple[Hostile, ...] = (
    *(Hostile(f"key-{name}", "key", danger, f"a key: {what}", _private(data)) for name, danger, what, data in _KEYS),
    *(
        Hostile(f"seal-{name}", "session", danger, what, file(f"seal-{name}.mcap", data))
        for name, danger, what, data in _SEALS
    ),
    *(
        Hostile(f"{sort}-{name}", sort, danger, f"a {sort}: {name}", file(f"{name}.toml", text.encode))
        for sort, rows in (("profile", _PROFILES), ("recipe", _RECIPES))
        for name, (danger, text) in rows.items()
    ),
)
