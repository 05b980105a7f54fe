"""Hostile folders of recordings, receipts of uploads, files of AWS, and settings of sites and of Zenoh."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from igtl_gateway.record.retention.retention_log import LOG_NAME
from igtl_gateway.record.retention.upload_state import SUFFIX
from tests.integration.hostile_files.case import ESCAPE, FORGED, MIB, NAUGHTY, SMALL, Danger, Hostile, file

_DEEP = "[" * 100_000 + "]" * 100_000
_NAME = "session"
_PLACE = "s3://bucket/prefix"


def _folder(change: Callable[[Path], object]) -> Callable[[Path], Path]:
    """A builder of a folder with a sound recording, which ``change`` makes hostile."""

    def build(folder: Path) -> Path:
        place = folder / "recordings"
        place.mkdir()
        shutil.copyfile(SMALL, place / f"{_NAME}.mcap")
        change(place)
        return place

    return build


def _receipt(data: Callable[[], bytes]) -> Callable[[Path], Path]:
    return _folder(lambda place: (place / f"{_NAME}{SUFFIX}").write_bytes(data()))


def _lines(*facts: object) -> Callable[[], bytes]:
    return lambda: b"".join(json.dumps(each).encode() + b"\n" for each in ({"to": _PLACE}, *facts))


def _facts(**facts: object) -> dict[str, object]:
    """What a receipt has about the recording, as if its upload had begun."""
    found = {"file": f"{_NAME}.mcap", "sha256": "0" * 64, "part_bytes": 8 << 20, "upload": "begun"}
    return found | {"size": SMALL.stat().st_size} | facts


def _fifo(name: str) -> Callable[[Path], Path]:
    return _folder(lambda place: os.mkfifo(place / name))


def _link(name: str) -> Callable[[Path], Path]:
    return _folder(lambda place: (place / name).symlink_to("/dev/zero"))


def _nested(place: Path) -> None:
    for number in range(200):
        (place / f"{number}" / "a" / "b").mkdir(parents=True)


def _many(place: Path) -> None:
    for number in range(3_000):
        (place / f"{number}{SUFFIX}").write_bytes(_lines(_facts(file=f"{number}.mcap"))())


def _naughty(place: Path) -> None:
    name = f"a{ESCAPE}\n{FORGED}".replace("/", "")
    (place / f"{_NAME}.mcap").rename(place / f"{name}.mcap")
    (place / f"{name}{SUFFIX}").write_bytes(_lines(_facts(file=f"{name}.mcap"))())


def _bytes_name(place: Path) -> None:
    os.rename(place / f"{_NAME}.mcap", os.fsencode(place) + b"/\xff\xfe.mcap")


_LOG = LOG_NAME
FOLDERS = tuple(
    Hostile(f"folder-{name}", "folder", danger, what, build)
    for name, danger, what, build in (
        ("receipt-empty", Danger.LIE, "a receipt of nothing", _receipt(lambda: b"")),
        ("receipt-zeros", Danger.BOMB, "a receipt of 64 MiB of zeros", _receipt(lambda: bytes(64 * MIB))),
        ("receipt-deep", Danger.BOMB, "a receipt that is nested 100,000 deep", _receipt(_DEEP.encode)),
        ("receipt-lines", Danger.BOMB, "a receipt of 100,000 lines", _receipt(_lines(*[_facts()] * 100_000))),
        (
            "receipt-files",
            Danger.BOMB,
            "a receipt of 100,000 files",
            _receipt(_lines(*({"file": f"{_NAME}/{number}.mcap", "size": 1} for number in range(100_000)))),
        ),
        ("receipt-list", Danger.SHAPE, "a receipt of lists", _receipt(_lines([1], [[]], 7, None))),
        ("receipt-text", Danger.SHAPE, "a receipt with text for numbers", _receipt(_lines(_facts(size="a", etag=4)))),
        ("receipt-part-0", Danger.LIE, "parts of 0 bytes", _receipt(_lines(_facts(part_bytes=0)))),
        ("receipt-part-minus", Danger.LIE, "parts of -1 bytes", _receipt(_lines(_facts(part_bytes=-1)))),
        ("receipt-part-1", Danger.BOMB, "parts of 1 byte", _receipt(_lines(_facts(part_bytes=1)))),
        ("receipt-part-huge", Danger.BOMB, "parts of 2^80 bytes", _receipt(_lines(_facts(part_bytes=1 << 80)))),
        ("receipt-size", Danger.LIE, "a size of 2^80 bytes", _receipt(_lines(_facts(size=1 << 80)))),
        ("receipt-path", Danger.LIE, "a file of another folder", _receipt(_lines(_facts(file=f"{_NAME}/../../a")))),
        ("receipt-confirmed", Danger.LIE, "a confirmation only", _receipt(_lines(_facts(confirmed="yes")))),
        ("receipt-place", Danger.TERMINAL, "a hostile place", _receipt(lambda: json.dumps({"to": NAUGHTY}).encode())),
        ("receipt-upload", Danger.TERMINAL, "a hostile upload", _receipt(_lines(_facts(upload=NAUGHTY)))),
        ("receipt-digest", Danger.TERMINAL, "a hostile digest", _receipt(_lines(_facts(sha256=NAUGHTY, etag=NAUGHTY)))),
        ("receipt-fifo", Danger.LIE, "a receipt that is a FIFO", _fifo(f"{_NAME}{SUFFIX}")),
        ("receipt-link", Danger.LIE, "a receipt that is a link to /dev/zero", _link(f"{_NAME}{SUFFIX}")),
        (
            "receipt-folder",
            Danger.LIE,
            "a receipt that is a folder",
            _folder(lambda p: (p / f"{_NAME}{SUFFIX}").mkdir()),
        ),
        ("receipts", Danger.BOMB, "3,000 receipts", _folder(_many)),
        ("names", Danger.TERMINAL, "names with escape sequences", _folder(_naughty)),
        ("name-bytes", Danger.TERMINAL, "a name that is invalid UTF-8", _folder(_bytes_name)),
        ("nested", Danger.BOMB, "200 folders in folders", _folder(_nested)),
        ("fifo", Danger.LIE, "a FIFO among recordings", _fifo("a.mcap")),
        ("link", Danger.LIE, "a link to /dev/zero among recordings", _link("a.mcap")),
        ("log-fifo", Danger.LIE, "a log of retention that is a FIFO", _fifo(_LOG)),
        ("log-link", Danger.LIE, "a log of retention that is a link", _link(_LOG)),
        (
            "log-zeros",
            Danger.BOMB,
            "a log of retention of zeros",
            _folder(lambda p: (p / _LOG).write_bytes(bytes(MIB))),
        ),
    )
)


def _aws(name: str, danger: Danger, what: str, build: Callable[[Path], Path]) -> Hostile:
    return Hostile(f"aws-{name}", "AWS file", danger, what, build)


def _made_fifo(folder: Path) -> Path:
    os.mkfifo(folder / "aws")
    return folder / "aws"


def _made_link(folder: Path) -> Path:
    (folder / "aws").symlink_to("/dev/zero")
    return folder / "aws"


_AWS_KEYS = "[default]\naws_access_key_id = {}\naws_secret_access_key = {}\n"
AWS = (
    _aws("fifo", Danger.LIE, "a FIFO without a writer", _made_fifo),
    _aws("zero", Danger.BOMB, "a link to /dev/zero", _made_link),
    _aws("zeros", Danger.BOMB, "64 MiB of zeros", file("aws", lambda: bytes(64 * MIB))),
    _aws(
        "sections",
        Danger.BOMB,
        "50,000 sections",
        file("aws", lambda: b"".join(b"[%d]\na=1\n" % n for n in range(50_000))),
    ),
    _aws("keys", Danger.BOMB, "a key of 900,000 characters", file("aws", _AWS_KEYS.format("a" * 900_000, "b").encode)),
    _aws(
        "line", Danger.TERMINAL, "keys with escape sequences", file("aws", _AWS_KEYS.format("a\x1b[2J\r", "b\0").encode)
    ),
    _aws("utf-8", Danger.SHAPE, "invalid UTF-8", file("aws", lambda: b"[default]\naws_access_key_id=\xff\xfe\n")),
)


def _router(name: str, danger: Danger, what: str, build: Callable[[Path], Path]) -> Hostile:
    return Hostile(f"zenoh-{name}", "Zenoh configuration", danger, what, build)


def _json5(text: str | bytes, name: str = "zenoh.json5") -> Callable[[Path], Path]:
    return file(name, lambda: text if isinstance(text, bytes) else text.encode())


def _named_fifo(folder: Path) -> Path:
    os.mkfifo(folder / "zenoh.json5")
    return folder / "zenoh.json5"


def _named_link(folder: Path) -> Path:
    (folder / "zenoh.json5").symlink_to("/dev/zero")
    return folder / "zenoh.json5"


_HERE = '{mode: "router", listen: {endpoints: ["tcp/127.0.0.1:0"]}, scouting: {multicast: {enabled: false}}, %s}'
ZENOH = (
    _router("empty", Danger.LIE, "nothing", _json5("")),
    _router("fifo", Danger.LIE, "a FIFO without a writer", _named_fifo),
    _router("zero", Danger.BOMB, "a link to /dev/zero", _named_link),
    _router("folder", Danger.LIE, "a folder", lambda folder: folder),
    _router("zeros", Danger.BOMB, "64 MiB of zeros", file("zenoh.json5", lambda: bytes(64 * MIB))),
    _router("deep", Danger.BOMB, "JSON5 that is nested 100,000 deep", _json5(_DEEP)),
    _router(
        "deep-300",
        Danger.BOMB,
        "a value that is nested 300 deep",
        _json5(_HERE % ("metadata: " + "[" * 300 + "]" * 300)),
    ),
    _router("deep-yaml", Danger.BOMB, "YAML that is nested 100,000 deep", _json5(_DEEP, "zenoh.yaml")),
    _router(
        "aliases",
        Danger.BOMB,
        "YAML with aliases of aliases",
        _json5(
            "a: &a [x,x,x,x,x,x,x,x,x]\n"
            + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{','.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(9)),
            "zenoh.yaml",
        ),
    ),
    _router("utf-8", Danger.SHAPE, "invalid UTF-8", _json5(b"{mode: '\xff\xfe'}")),
    _router("list", Danger.SHAPE, "a list", _json5("[1, 2]")),
    _router("number", Danger.SHAPE, "numbers for names", _json5("{mode: 3, listen: 4}")),
    _router(
        "endpoints",
        Danger.SHAPE,
        "an endpoint of no kind",
        _json5('{mode: "router", listen: {endpoints: ["", "x", 7]}}'),
    ),
    _router(
        "many",
        Danger.BOMB,
        "20,000 endpoints",
        _json5(_HERE % "connect: {endpoints: [%s]}" % ",".join(['"tcp/127.0.0.1:9"'] * 20_000)),
    ),
    _router("naughty", Danger.TERMINAL, "keys with escape sequences", _json5(json.dumps({NAUGHTY: 1}))),
    _router(
        "naughty-endpoint",
        Danger.TERMINAL,
        "an endpoint with escape sequences",
        _json5(json.dumps({"mode": "router", "listen": {"endpoints": [f"tcp/{NAUGHTY}:1"]}})),
    ),
    _router(
        "naughty-file",
        Danger.TERMINAL,
        "a certificate with escape sequences in its name",
        _json5(_HERE % f"transport: {{link: {{tls: {{root_ca_certificate: {json.dumps(NAUGHTY)}}}}}}}"),
    ),
    _router("mode", Danger.TERMINAL, "a mode with escape sequences", _json5(json.dumps({"mode": NAUGHTY}))),
    _router(
        "plugin",
        Danger.LIE,
        "a plugin that is a file of another folder",
        _json5(_HERE % 'plugins_loading: {enabled: true}, plugins: {a: {__path__: "/dev/zero", __required__: true}}'),
    ),
    _router(
        "ok",
        Danger.LIE,
        "a router on any port that waits for 2^63 ms",
        _json5(_HERE % "transport: {unicast: {open_timeout: 9223372036854775807}}"),
    ),
)

_SITES = (
    "site = 7",
    "site = ''",
    f"site = {json.dumps('x' * 100_000)}",
    f"site = {json.dumps(NAUGHTY)}",
    "site = '../..'",
    "site_budget = -1",
    "site_budget = inf",
    "site_budget = 'a'",
    "site_classes = {'/a' = 'x'}",
    f"site_classes = {{{json.dumps(NAUGHTY)} = 'poses'}}",
    f"site_classes = ['{'*' * 200}=poses']",
    "site_classes = " + "[" * 300 + "]" * 300,
)
SITES = tuple(
    Hostile(
        f"site-{number}",
        "configuration",
        Danger.TERMINAL if "FORGED" in text else Danger.SHAPE,
        f"`{text[:60]}`" if "FORGED" not in text else "a site with escape sequences",
        file(f"site-{number}.toml", f"[ros]\n{text}\n".encode),
    )
    for number, text in enumerate(_SITES)
)

CASES = FOLDERS + AWS + ZENOH + SITES
