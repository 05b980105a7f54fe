"""Hostile descriptions of robots: as files for ``view --urdf``, and in recordings."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from html import escape
from pathlib import Path

from tests.integration.hostile_files.case import GIB, MIB, NAUGHTY, Danger, Hostile, file
from tests.integration.hostile_files.foreign import bag
from tests.record import samples


def robot(inner: str, head: str = "") -> str:
    """A URDF with one link and what else is in it."""
    return f'{head}<robot name="arm"><link name="base"/>{inner}</robot>'


def doctype(inner: str, text: str = "&z;") -> str:
    return f'<!DOCTYPE robot [{inner}]><robot name="{text}"><link name="base"/></robot>'


def joint(name: str, parent: str, child: str, more: str = "", kind: str = "revolute") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


def meshes(*names: str) -> str:
    bodies = "".join(f'<visual><geometry><mesh filename="{escape(name)}"/></geometry></visual>' for name in names)
    return f'<robot name="arm"><link name="base">{bodies}</link></robot>'


def chain(length: int) -> str:
    links = "".join(f'<link name="l{number}"/>' for number in range(length))
    return f"<robot>{links}{''.join(joint(f'j{n}', f'l{n}', f'l{n + 1}') for n in range(length - 1))}</robot>"


_LAUGHS = '<!ENTITY a "ha">' + "".join(
    f'<!ENTITY {name} "{f"&{before};" * 10}">' for before, name in zip("abcdefghij", "bcdefghijz", strict=True)
)
_LARGE = f'<!ENTITY z "{"z" * 100_000}">'
_ESCAPED = escape(NAUGHTY.replace("\x1b", "").replace("\x07", ""))  # XML has no control characters


def two(more: str = "", name: str = "j", kind: str = "revolute") -> str:
    """A URDF with one joint."""
    return robot('<link name="a"/>' + joint(name, "base", "a", more, kind))


def named(name: str) -> str:
    """A URDF with two links of one name."""
    return f'<robot name="{name}"><link name="{name}"/><link name="{name}"/></robot>'


def many(text: str, count: int) -> str:
    """A string repeated, with its number for %d."""
    return "".join(text % number for number in range(count))


_PATHS = (
    "file:///etc/passwd",
    "/dev/zero",
    "/dev/stdin.stl",
    "../../../../../etc/passwd.stl",
    "http://127.0.0.1:9/a.stl",
    "package://../../etc/passwd.stl",
    "package:///etc/passwd.stl",
    f"{_ESCAPED}.stl",
    "//host/share/a.stl",
)
_WIDE, _ATTRIBUTE = "<robot %s/>", 'a%d="" '
_SERVER = '<!DOCTYPE robot SYSTEM "http://127.0.0.1:9/a.dtd"><robot/>'
_PASSWD = '<!ENTITY z SYSTEM "file:///etc/passwd">'
_RING = robot('<link name="a"/>' + joint("j", "base", "a") + joint("k", "a", "base"))
_MIMIC = '<mimic joint="j"/>'
_NAN = '<origin xyz="nan inf 1e999"/>'
_BODIES = ["package://a/b.stl"] * 5000

#: Name → danger, what it is, text.
_TEXTS: tuple[tuple[str, Danger, str, Callable[[], str]], ...] = (
    ("laughs", Danger.BOMB, "entities that expand to 10^10 words", lambda: doctype(_LAUGHS)),
    ("quadratic", Danger.BOMB, "one large entity, repeated", lambda: doctype(_LARGE, "&z;" * 5000)),
    ("external", Danger.LIE, "an entity that is another file", lambda: doctype(_PASSWD)),
    ("remote", Danger.LIE, "a document type on a server", lambda: _SERVER),
    ("deep", Danger.BOMB, "50,000 nested elements", lambda: "<robot>" + "<a>" * 50_000),
    ("large", Danger.BOMB, "40 MB of spaces", lambda: robot(" " * 40 * MIB)),
    ("links", Danger.BOMB, "20,000 links", lambda: robot(many('<link name="l%d"/>', 20_000))),
    ("bodies", Danger.BOMB, "5,000 bodies", lambda: meshes(*_BODIES)),
    ("chain", Danger.BOMB, "a chain of 1,000 links", lambda: chain(1000)),
    ("attributes", Danger.BOMB, "an element with 30,000 attributes", lambda: _WIDE % many(_ATTRIBUTE, 30_000)),
    ("ring", Danger.SHAPE, "a ring of links", lambda: _RING),
    ("mimic-ring", Danger.SHAPE, "a joint that mimics itself", lambda: two(_MIMIC)),
    ("not-a-number", Danger.SHAPE, "an origin that is not a number", lambda: two(_NAN)),
    ("names", Danger.TERMINAL, "names that print lines", lambda: named(_ESCAPED)),
    ("types", Danger.TERMINAL, "a type of joint that prints lines", lambda: two(name=_ESCAPED, kind=_ESCAPED)),
    ("no-xml", Danger.SHAPE, "no XML", lambda: "robot: {name: arm}"),
    ("other-xml", Danger.SHAPE, "other XML", lambda: "<html/>"),
    ("mesh-paths", Danger.LIE, "meshes that are other files, devices, servers", lambda: meshes(*_PATHS)),
)


def _text(text: Callable[[], str]) -> bytes:
    return text().encode("utf-8", "replace")


def _recorded(text: Callable[[], str]) -> bytes:
    """A recording in which a URDF is latched twice."""
    return bag(topic="/robot_description", data=(samples.string_cdr(text()),) * 2)


def _with_mesh(name: str, make: Callable[[Path], object]) -> Callable[[Path], Path]:
    """A URDF beside a mesh."""

    def build(folder: Path) -> Path:
        make(folder / name)
        path = folder / "arm.urdf"
        path.write_text(meshes(name), "utf-8")
        return path

    return build


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(4 * GIB)


_LONG_STL = b"solid " + b"facet\n" * 1_000_000
_LIE_GLB = b"glTF\2\0\0\0\xff\xff\xff\xff\xff\xff\xff\x7fJSON" + b"[" * 1_000_000
_DAE = b'<!DOCTYPE a [<!ENTITY z "z">]><COLLADA>&z;</COLLADA>'

#: Name → what it is, file name, what makes it.
_MESHES: tuple[tuple[str, str, str, Callable[[Path], object]], ...] = (
    ("fifo", "a mesh that is a FIFO", "a.stl", os.mkfifo),
    ("link", "a mesh that is a link out of the folder", "a.stl", lambda path: path.symlink_to("/etc/passwd")),
    ("sparse", "a mesh of 4 GiB", "a.stl", _sparse),
    ("stl", "a mesh of endless facets", "a.stl", lambda path: path.write_bytes(_LONG_STL)),
    ("glb", "a mesh that declares 4 GiB", "a.glb", lambda path: path.write_bytes(_LIE_GLB)),
    ("dae", "a mesh with entities", "a.dae", lambda path: path.write_bytes(_DAE)),
    ("folder", "a mesh that is a folder", "a.stl", lambda path: path.mkdir()),
)

_UTF16 = '<?xml version="1.0" encoding="utf-8"?><robot/>'.encode("utf-16")
_IN_RECORDINGS = ("laughs", "external", "bodies", "names", "mesh-paths")

CASES: tuple[Hostile, ...] = (
    *(
        Hostile(f"urdf-{name}", "robot", danger, what, file("arm.urdf", partial(_text, text)))
        for name, danger, what, text in _TEXTS
    ),
    *(
        Hostile(f"urdf-mesh-{name}", "robot", Danger.LIE, what, _with_mesh(mesh, make))
        for name, what, mesh, make in _MESHES
    ),
    Hostile("urdf-utf16", "robot", Danger.SHAPE, "UTF-16 with a wrong declaration", file("arm.urdf", lambda: _UTF16)),
    *(
        Hostile(f"foreign-urdf-{name}", "foreign MCAP", danger, f"a robot: {what}", file(f"{name}.mcap", make))
        for name, danger, what, text in _TEXTS
        if name in _IN_RECORDINGS
        for make in (partial(_recorded, text),)
    ),
)
