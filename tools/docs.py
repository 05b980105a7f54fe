"""The generated pages of docs/, from the tables that the program itself works with.

    .venv/bin/python tools/docs.py             write them again
    .venv/bin/python tools/docs.py --check     are they current?

Strategy: facts come from the tables (layouts and registry of the wire, conversions, profiles, definitions) and from the
docstrings of what stands in them; only what leads from one table to the next is written here.  A sentence about a type
belongs into the docstring of its class, after ``Accepted:`` or ``Sent:`` where it is about that.
"""

from __future__ import annotations

import argparse
import inspect
import json
import posixpath
import re
import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from igtl_gateway.app.commands import SERVICE
from igtl_gateway.app.recording import PAUSE, RESUME, SNAPSHOT
from igtl_gateway.app.recording import TYPE as TRIGGER
from igtl_gateway.cli import complete
from igtl_gateway.cli.options import argument_name
from igtl_gateway.cli.verbs import Verb, available
from igtl_gateway.config import Config
from igtl_gateway.convert.commands import ERROR_MESSAGE, STATUS
from igtl_gateway.convert.names import MAX_TOKEN, frames_of, short_device_name, topic_token
from igtl_gateway.convert.profiles import CPP_FACTORY, PLUS_1, PROFILES, UNRECOGNISED, PeerProfile
from igtl_gateway.convert.table import TO_IGTL, TO_ROS, ConversionToIgtl, ConversionToRos, Role
from igtl_gateway.doctor import checks, host_checks, host_probe
from igtl_gateway.doctor.observer import MAX_STREAMS
from igtl_gateway.doctor.protocols import PROTOCOLS
from igtl_gateway.doctor.rules import RULES, Rule
from igtl_gateway.edges.ros.parameters import constraints, description
from igtl_gateway.gateway import metadata
from igtl_gateway.gateway.diagnostics import DIAGNOSTICS_TOPIC
from igtl_gateway.gateway.dialogue import answers
from igtl_gateway.gateway.dialogue.links import LINKS_TOPIC
from igtl_gateway.qos import Qos
from igtl_gateway.settings import ROWS, SETTINGS, Setting, of_table
from igtl_gateway.stamp import NS_PER_MS
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.header import Header
from igtl_gateway.wire.layout import Layout
from igtl_gateway.wire.message import MAX_METADATA_ACCEPTED, MAX_METADATA_SENT, METADATA_LAYOUT, ExtendedHeader
from igtl_gateway.wire.query import PREFIXES, QUERIES, query_name, split_query
from igtl_gateway.wire.registry import ALIASES, BODIES
from igtl_gateway.wire.sensor import PREFIXES as UNIT_PREFIXES
from igtl_gateway.wire.sensor import UNITS
from igtl_gateway.wire.text import CODES
from tools import deidentify_page
from tools.note_codes import NOTES

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
DEFINITIONS = ROOT / "ros2" / "igtl_msgs"
DOCUMENTS = "https://github.com/openigtlink/OpenIGTLink/blob/master/Documents/Protocol"

GENERATED = "<!-- Made by tools/docs.py from the program's own tables: change those, not this. -->"
#: What stands between these is kept where the material for it is not at hand.
CONFORMANCE = ("<!-- conformance -->", "<!-- /conformance -->")

#: Key of the metadata → its meaning; a test holds the keys against ``metadata.OURS``.
KEYS = {
    metadata.FULL_NAME: "device name, if it is longer than the 20 bytes of the header",
    metadata.STAMP: "stamp of the ROS header, UTC nanoseconds as a decimal number",
    metadata.FRAME_ID: "`frame_id` of the ROS header; for a transform the parent frame",
    metadata.CHILD_FRAME_ID: "`child_frame_id` of a transform",
}


# -- Markdown ---------------------------------------------------------------------------------------------------------


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], right: str = "") -> str:
    """A table; columns named in ``right`` (by their letters a, b, …) are numbers."""
    rules = ["---:" if "abcdefghij"[index] in right else "---" for index in range(len(heads))]
    lines = [heads, rules, *([str(cell).replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def prose(text: str) -> str:
    """Paragraphs of a docstring or of this file as Markdown, in lines of 120 characters."""
    paragraphs = (" ".join(part.split()) for part in text.replace("``", "`").split("\n\n"))
    return "\n\n".join(
        textwrap.fill(part, 120, break_long_words=False, break_on_hyphens=False) for part in paragraphs if part
    )


def code(names: Iterable[str], joint: str = ", ") -> str:
    return joint.join(f"`{name}`" for name in names)


def anchor(title: str) -> str:
    """As GitHub makes it of a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def document(*parts: str) -> str:
    return "\n\n".join(part for part in parts if part) + "\n"


# -- docstrings -------------------------------------------------------------------------------------------------------


def paragraphs(thing: Any) -> list[str]:
    """The docstring of a class without its list of attributes; the first paragraph without the type's name."""
    text = inspect.getdoc(thing) or ""
    return [
        " ".join(part.split()).replace("``", "`") for part in text.partition("Attributes:")[0].split("\n\n") if part
    ]


def attributes(thing: Any) -> dict[str, str]:
    """The attributes in the docstring of a class, with their descriptions."""
    told: dict[str, str] = {}
    names: list[str] = []
    for line in (inspect.getdoc(thing) or "").partition("Attributes:")[2].splitlines():
        if match := re.fullmatch(r" {4}(\w+(?:, \w+)*): (.*)", line):
            names = match[1].split(", ")
            told |= dict.fromkeys(names, match[2])
        elif line.strip():
            told |= {name: f"{told[name]} {line.strip()}" for name in names}
    return {name: " ".join(text.split()).replace("``", "`").rstrip(".") for name, text in told.items()}


_DOCUMENT = re.compile(r"\s*\(`Protocol/(\w+\.md)`.*?\)")


def summary(kind: type[Body]) -> tuple[str, str]:
    """What a class of contents is, and the protocol's document about it."""
    first = paragraphs(kind)[0]
    module = inspect.getmodule(kind)
    found = _DOCUMENT.search(first) or _DOCUMENT.search((inspect.getdoc(module) or "").replace("``", "`"))
    text = _DOCUMENT.sub("", first).partition(": ")[2] or first
    return text[0].upper() + text[1:], found[1] if found else ""


def layout_of(kind: type[Body]) -> Layout:
    """Every class of contents has one; a test holds that."""
    rows: Layout = kind.LAYOUT  # type: ignore[attr-defined]
    return rows


def protocol_of(kind: type[Body]) -> str:
    """The version of the protocol that brought a type; queries have none of their own."""
    version: str = kind.PROTOCOL  # type: ignore[attr-defined]
    return version


# -- layouts ----------------------------------------------------------------------------------------------------------


def layout(rows: Layout, meanings: dict[str, str]) -> str:
    """A layout as a table; ``meanings`` has descriptions of fields without one."""
    lines = []
    offset: int | None = 0
    for row in rows:
        place = "…" if offset is None or row.per else str(offset)
        size: object = row.size
        if row.size is None:
            size = row.count if row.type in ("char", "bytes") else ""
        kind = row.type if row.count == 1 or row.type == "bytes" else f"{row.type}[{row.count}]"
        if row.type == "char" and row.size is None:
            kind = "char[]"
        if row.per:
            size = f"{size} per {row.per}".strip()
        about = row.about.replace("``", "`") or meanings.get(row.name, "")
        lines.append((place, size, kind, f"`{row.name}`", about))
        offset = offset + row.size if offset is not None and row.size is not None and not row.per else None
    return table(("offset", "bytes", "type", "field", "meaning"), lines, "a")


# -- docs/reference/messages.md ---------------------------------------------------------------------------------------


@cache
def sections() -> dict[str, tuple[type[Body], list[str]]]:
    """Title → class and type names of everything but queries, by title."""
    names: dict[type[Body], list[str]] = {}
    for name, kind in BODIES.items():
        if name not in QUERIES and name not in ALIASES:
            names.setdefault(kind, []).append(name)
    return {", ".join(types): (kind, types) for kind, types in sorted(names.items(), key=lambda item: item[1])}


def queries_of(base: str) -> list[str]:
    """The queries of a type of data that there are, in the order GET, STT, STP, RTS."""
    return [name for prefix in PREFIXES if (name := query_name(prefix, base)) in QUERIES]


def is_sent(name: str) -> bool:
    """Whether there is a conversion from ROS to a type; everything else goes out as it is, by igtl_msgs/RawMessage."""
    return name in QUERIES or any(row.igtl_type == name for row in TO_IGTL)


def messages() -> str:
    """docs/reference/messages.md."""
    return document(
        "# OpenIGTLink messages",
        GENERATED,
        prose(
            """All message types that the gateway reads and writes: their layout, units, the deviations that it accepts
            and what it sends.  [conversions.md](conversions.md) describes their conversion to ROS.  Messages of other
            types are forwarded, recorded and replayed with unchanged bytes."""
        ),
        _overview(),
        _frame(),
        "## Types",
        *(_type(title, kind, types) for title, (kind, types) in sections().items()),
        _queries(),
        _metadata(),
        _profiles(),
        _conformance(),
    )


def _overview() -> str:
    rows = []
    for title, (kind, types) in sections().items():
        read_too = code(name for name, meant in ALIASES.items() if meant in types)
        name = code(types) + (f" ({read_too})" if read_too else "")
        way = "in, out" if all(map(is_sent, types)) else "in"
        rows.append((f"[{name}](#{anchor(title)})", protocol_of(kind), way, summary(kind)[0].rstrip(".")))
    return document(
        "## Overview",
        prose(
            """*Since* is the protocol version that introduced a type: versions 1 and 2 use header version 1, version 3
            uses header version 2; every type can be sent with either.  Names in parentheses are accepted but never
            sent.  *out*: ROS messages are converted to it, or the gateway creates it; complete messages of any type
            can be sent as `igtl_msgs/RawMessage`.  Queries are [below](#queries)."""
        ),
        table(("type", "since", "direction", "content"), rows),
    ).rstrip()


def _frame() -> str:
    return document(
        "## Around the content",
        prose(
            f"""Numbers are big-endian, except pixels and encoded frames, whose messages declare their byte order.
            There is no alignment.  Lengths are millimetres.  Offsets in a content count from the end of the header
            (version 1) or of the extended header (version 2).

            **Accepted:** text that is invalid UTF-8, and bytes after the first NUL of a field (they are kept, but not
            shown); an extended header of more than 12 bytes; a missing metadata header; up to
            {MAX_METADATA_ACCEPTED:,} bytes of metadata; a message without content of a type that should have one.  All
            of these are encoded again as received.  Sizes are checked before memory is allocated.  A message with a
            wrong CRC is rejected (`check_crc = false` disables the check), as is everything that is rejected below; a
            note in the recording has the reason.

            **Sent:** header version 1, until a peer has sent version 2 or its [profile](#peer-profiles) requires
            another version.  Text is UTF-8, cut at a character boundary to one byte less than its field (C++ readers
            drop text that fills it) and padded with zeros; device names can use all 20 bytes.  At most
            {MAX_METADATA_SENT:,} bytes of metadata, one value for each key, sorted by key; the metadata header is
            present even without metadata.  The CRC is always valid, message ids are 0."""
        ),
        "### Header",
        layout(Header.LAYOUT, attributes(Header)),
        prose(
            """The time stamp is in seconds since 1970 (UTC) as 32.32 fixed point; 0 means unset, not 1970.  It is
            converted to nanoseconds and back like in the reference library, without loss."""
        ),
        "### Extended header",
        "Header version 2 only, at the beginning of the body.",
        layout(ExtendedHeader.LAYOUT, attributes(ExtendedHeader)),
        "### Metadata",
        "Header version 2 only, at the end of the body. The sizes of all items come first, then all strings.",
        layout(METADATA_LAYOUT, {}),
    ).rstrip()


def _type(title: str, kind: type[Body], types: list[str]) -> str:
    text, source = summary(kind)
    facts = [f"Protocol version {protocol_of(kind)}" + (f", [{source}]({DOCUMENTS}/{source})" if source else "")]
    if read_too := [name for name, meant in ALIASES.items() if meant in types]:
        facts.append(f"Accepted, but never sent: {code(read_too)}")
    if asked := [name for base in types for name in queries_of(base)]:
        facts.append(f"[Queries](#queries): {code(asked)}")
    facts += _ros_facts(types)
    rows = layout_of(kind)
    size = ""
    if issubclass(kind, Elements):
        size = f"Elements of {kind.DTYPE.itemsize} bytes; the size of the content determines their number:"
    elif len([row for row in rows if row.per]) > 1:
        per = next(row.per for row in rows if row.per)
        size = f"Adjacent rows *per {per}* form a group: the group of the first {per}, of the second, …"
    return document(
        f"### {title}",
        prose(text),
        "\n".join(f"- {fact}" for fact in facts),
        size,
        layout(rows, attributes(kind)),
        *(prose(_marked(part)) for part in paragraphs(kind)[1:] if not _ABOUT_EQUALITY.match(part)),
        *_EXTRAS.get(title, ()),
    ).rstrip()


def _marked(paragraph: str) -> str:
    return re.sub(r"^(Accepted|Sent):", r"**\1:**", paragraph)


def _ros_facts(types: list[str]) -> list[str]:
    facts = []
    if to_ros := list(dict.fromkeys(ros_name(row.message.TYPE) for row in TO_ROS if set(types) & set(row.igtl_types))):
        title = next(title for title, rows in ros_sections().items() if set(types) & set(rows[0].igtl_types))
        facts.append(f"[To ROS](conversions.md#{anchor(title)}): {_shortened(to_ros)}")
    if from_ros := list(dict.fromkeys(ros_name(row.message.TYPE) for row in TO_IGTL if row.igtl_type in types)):
        facts.append(f"[From ROS](conversions.md#ros-to-openigtlink): {_shortened(from_ros)}")
    return facts


def _shortened(names: list[str]) -> str:
    """The array types of std_msgs are many and alike."""
    arrays = [name for name in names if name.endswith("MultiArray")]
    others = [name for name in names if name not in arrays]
    if len(arrays) > 2:
        return ", ".join([*others, "std_msgs/…MultiArray"])
    return ", ".join(others + arrays)


def _units() -> str:
    prefixes = table(
        ("code", "prefix", "power of ten"),
        ((f"`{key:X}`", symbol or "none", power) for key, (symbol, power) in UNIT_PREFIXES.items()),
        "c",
    )
    units = ", ".join(f"`{number:02X}` {symbol}" for number, symbol in enumerate(UNITS, start=1))
    return f"{prefixes}\n\n" + prose(f"Units (`00` = none; the unit of mass is the gram): {units}.  Exponents: -7 … 7.")


#: Two values in Python, not two messages.
_ABOUT_EQUALITY = re.compile("Two |Equality ")

_EXTRAS = {
    "STATUS": (prose("Codes: " + ", ".join(f"{number} {text}" for number, text in enumerate(CODES)) + "."),),
    "SENSOR": (_units(),),
}


def _queries() -> str:
    bases: dict[str, dict[str, str]] = {}
    for name in QUERIES:
        if name not in ALIASES:
            prefix, base = split_query(name) or ("", "")
            bases.setdefault(base, {})[prefix] = name
    rows = [
        (f"`{base}`", *(f"`{has[prefix]}`" if prefix in has else "" for prefix in PREFIXES))
        for base, has in sorted(bases.items())
    ]
    contents: dict[type[Body], list[str]] = {}
    for name in sorted(QUERIES.keys() - ALIASES.keys()):
        contents.setdefault(QUERIES[name], []).append(name)
    parts = []
    for kind, names in sorted(contents.items(), key=lambda item: (not layout_of(item[0]), item[1])):
        rest = [prose(_marked(part)) for part in paragraphs(kind)[1:]]
        if not layout_of(kind):
            parts += ["### All other queries", "No content.", *rest]
            continue
        title = "RTS_ of every type" if len(names) > 2 else ", ".join(names)
        parts += [f"### {title}", prose(summary(kind)[0]), layout(layout_of(kind), attributes(kind)), *rest]
    told = prose((inspect.getdoc(answers) or "").replace("Answers to queries: ", ""))
    return document(
        "## Queries",
        prose(
            """`GET_` requests one message, `STT_` starts a stream, `STP_` stops it, `RTS_` is the reply.  The device
            name selects the device; an empty name means any.  `GET_TRANSFOR`, which some of the documents have, is read
            as `GET_TRANS`, and so on."""
        ),
        table(("type", *(f"`{prefix}_`" for prefix in PREFIXES)), rows),
        told,
        prose("In ROS all queries are [`igtl_msgs/Query`](../../ros2/igtl_msgs/msg/Query.msg)."),
        *parts,
    ).rstrip()


def _metadata() -> str:
    rows = [(f"`{key}`", KEYS[key]) for key in sorted(KEYS)]
    return document(
        "## Metadata keys",
        prose(
            f"""The gateway sends these keys to every peer with header version 2, and evaluates them in messages to ROS.
            If a value does not have the format that the gateway writes, it is treated as the user's.  All other
            metadata belongs to the user: it is part of the messages of `igtl_msgs`, or published beside standard
            messages as `igtl_msgs/Metadata`, and it is sent unchanged.  In replies to a COMMAND, `{STATUS}`
            (`SUCCESS` or `FAIL`) and `{ERROR_MESSAGE}` are the result."""
        ),
        table(("key", "value"), rows),
    ).rstrip()


# -- peer profiles ----------------------------------------------------------------------------------------------------


def _profiles() -> str:
    rows = [
        (
            f"[`{profile.name}`](#profile-{profile.name})",
            f"{profile.first_version}, at most {profile.max_version}",
            _types(profile.reads),
            _types(profile.queries, "as types"),
            _types(profile.replies, "as types"),
            "yes" if profile.takes_empty else "no",
            f"{profile.ping_ns // NS_PER_MS} ms" if profile.ping_ns else "",
        )
        for profile in PROFILES
    ]
    heads = ("profile", "header version", "types", "queries", "`RTS_`", "empty bodies", "ping")
    return document(
        "## Peer profiles",
        prose(
            """What the gateway knows about OpenIGTLink programs.  The profile of a peer is set by option (`profile`,
            `[[peers]]` in [the configuration](../../igtl_gateway/config.py)) or detected from its messages; until then
            it is `unrecognised`.  *header version*: the initial version; it rises to that which the peer has sent.
            *types*, *queries* and `RTS_`: what the gateway may send to it.  *empty bodies*: whether it accepts a
            version 1 message without content as the reply to a query that cannot be answered.  *ping*: after this
            time without a message to it, the gateway sends a GET_STATUS.  In the sources, § is a section of the
            project's notes on the protocol; *reproduced* was tested with the program or its library."""
        ),
        table(heads, rows),
        "### Peers that are not recognised",
        prose(
            """A program that was not built for a type should skip it by its length.  PLUS and other
            programs on the factory of the C++ library do not: after a type that the factory does not
            know they lose the stream, or crash.  So a peer that is not recognised, and has shown header
            version 1 only, gets the types of the factory, and each type that it has sent, asked for
            (GET_, STT_) or listed (CAPABILITY).  What is held back is in the loss ledger
            (`not_for_unrecognised`), and a note (`not_for_peer`) names it once.  The profile `default`
            for a peer (`--peer HOST:PORT=default`), or `--no-cautious` for all, sends all types.  So does a bridge of
            CRTK arms.
            Recordings that are older than this rule are verified and replayed without it.

            PLUS sends version 1 until it has received version 2.  It is recognised from CLIENTINFO,
            from the reply to a command (`<CommandReply …>`) and from TDATA named `TDATA_<n>Elem`.
            TRANSFORM and IMAGE of one stamp and in one order, with names such as `ProbeToTracker`, give
            it the profile `plus-v1`: other programs could send these, too, and might not read version
            2."""
        ),
        prose(
            """`replay` treats the programs that listen in the same way, and sends no recorded query and no reply to one
            unless `--profile` names a profile that permits them: a recorded query has no use, and 3D Slicer crashes at
            it.  It waits up to 0.5 s for the first message of a listener, which shows 3D Slicer.  What was left out or
            adapted is in its report, by listener and type.  `--exact` and `--profile default` send every recorded byte.
            A replay of a relay's recording sends all bytes, except to a listener that is recognised."""
        ),
        table(("fact", "source"), UNRECOGNISED.facts),
        *map(_profile, PROFILES),
    ).rstrip()


def _types(names: frozenset[str] | None, everything: str = "all") -> str:
    if names is None:
        return everything
    if names >= CPP_FACTORY:
        return "the factory's"
    return code(sorted(names)) or "none"


def _profile(profile: PeerProfile) -> str:
    default = PeerProfile.__dataclass_fields__["shows"].default
    parts = [
        f"### Profile {profile.name}",
        "Detected from its messages." if profile.shows is not default or profile is PLUS_1 else "",
        table(("fact", "source"), profile.facts),
    ]
    if profile.expects:
        parts.append(f"Gets the metadata that it expects with {code(sorted(map(_sections_of, profile.expects)))}.")
    if profile.adapt:
        parts.append("\n".join(f"- {_sections_of(kind)}: {paragraphs(how)[0]}" for kind, how in profile.adapt.items()))
    if profile.reads is not None and profile.reads >= CPP_FACTORY:
        parts.append(prose(f"The types of its factory: {code(sorted(profile.reads))}."))
    return document(*parts).rstrip()


def _sections_of(kind: type) -> str:
    return next(title for title, (content, _) in sections().items() if content is kind)


# -- conformance ------------------------------------------------------------------------------------------------------


def _conformance() -> str:
    begin, end = CONFORMANCE
    return document(
        "## Conformance",
        prose(
            """Messages of other implementations: the corpus made with the C++ library, the test vectors of the
            C library, and handmade files for cases that neither has.  Each passes through `igtl-gateway decode
            --reencode`; *decoded* messages have every value that their author wrote, *re-encoded* ones the same bytes.
            `tests/wire/test_conformance.py` tests it.  `python tools/fuzz.py --seconds 600 --seed 1` mutates these
            messages for ten minutes: each must be rejected, or encoded to the decoded bytes."""
        ),
        begin,
        _results(),
        end,
    ).rstrip()


def _results() -> str:
    """The table as counted, or as it is written where the corpus beside the project is not."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    from tests.wire import conformance

    begin, end = CONFORMANCE
    if not (conformance.SHARED / "corpus").exists():
        return (DOCS / "reference" / "messages.md").read_text("utf-8").partition(begin)[2].partition(end)[0].strip()
    return _counted(conformance)


@cache
def _counted(conformance: Any) -> str:
    """Takes a second."""
    return str(conformance.table(conformance.results()))


# -- docs/reference/conversions.md ------------------------------------------------------------------------------------


def ros_name(ros_type: str) -> str:
    """A type with a link to its definition where it is ours."""
    package, _, name = ros_type.partition("/msg/")
    if package == "igtl_msgs":
        return f"[{package}/{name}](../../ros2/igtl_msgs/msg/{name}.msg)"
    return f"{package}/{name}"


@cache
def ros_sections() -> dict[str, tuple[ConversionToRos, ...]]:
    """Title → rows of OpenIGTLink types, by title; the queries last."""
    found: dict[str, list[ConversionToRos]] = {}
    for row in TO_ROS:
        names = [name for name in row.igtl_types if name not in ALIASES]
        found.setdefault("Queries" if names[0] in QUERIES else ", ".join(names), []).append(row)
    return {title: tuple(rows) for title, rows in sorted(found.items(), key=lambda item: (item[0] == "Queries", item))}


def conversions() -> str:
    """docs/reference/conversions.md."""
    return document(
        "# Conversions between OpenIGTLink and ROS 2",
        GENERATED,
        prose(
            """All conversions, and what each of them loses.  If the column *lost* is empty (–), a round trip is
            exact; tests check it.  [messages.md](messages.md) has the layouts of the OpenIGTLink messages."""
        ),
        _names(),
        _stamps(),
        _to_ros(),
        _to_igtl(),
        _definitions(),
    )


def _names() -> str:
    base = Config().base_frame
    devices = ("ProbeToTracker", "Probe", "US probe/1", "3rd")
    rows = [
        (
            f"`{name}`",
            f"`/igtl/in/{topic_token(name)}/transform`",
            *(f"`{frame}`" for frame in frames_of(topic_token(name), base)),
        )
        for name in devices
    ]
    long = "ReferenceFrameToStereoCamera"
    return document(
        "## Names, topics and frames",
        prose(
            f"""Messages of a device are published on `/igtl/in/<device>/<kind>`; `kind` is in the tables below.  Rows
            `[[to_ros]]` of [the configuration](../../igtl_gateway/config.py) select other topics, other frames, and
            kinds.  In the topic, characters other than letters, digits and `_` become `_`; a leading digit gets the
            prefix
            `_`; names of more than {MAX_TOKEN} characters are cut and get a hash.  If two devices would have the same
            topic, the second one gets a hash too.  A pose of a device with the name `AToB` is the pose of frame `A` in
            frame `B`, as in PLUS and other programs; every other name is a frame in the base frame `{base}`.  Frames
            in the [metadata](messages.md#metadata-keys) override those of the name; frames in the configuration
            override both.  Poses are also published on `/tf` (`publish_tf`)."""
        ),
        table(("device", "topic of a TRANSFORM", "parent frame", "child frame"), rows),
        prose(
            f"""Messages on topics below `/igtl/out/` are sent to the peers.  `/igtl/out/Probe` has the device name
            `Probe`; so has `/igtl/out/Probe/transform`, because the last token is the kind of its type.  Rows
            `[[to_igtl]]` select other topics, and set device name and type.  A name of more than 20 bytes is cut and
            gets a hash (`{long}` is sent as `{short_device_name(long)}`); the full name is sent as metadata.  Rows
            `[[tf_out]]` and `--tf-out frame:base` send frames of `/tf` and `/tf_static`, with chains composed, as
            TRANSFORM, POSITION, TDATA or QTDATA."""
        ),
    ).rstrip()


def _stamps() -> str:
    config = Config()
    return document(
        "## Stamps, units and metadata",
        prose(
            f"""A ROS header gets the sender's time stamp: the one in the [metadata](messages.md#metadata-keys),
            otherwise that of the OpenIGTLink header, otherwise (both unset, 0) the gateway's time of receipt.  In the
            other direction, the stamp is that of the ROS header, otherwise the gateway's time.  It is also sent as
            metadata, for programs that do not pass on the header's.  `stamp = "receive"` always takes the gateway's.

            Lengths are {config.ros_unit} in ROS and {config.igtl_unit} in OpenIGTLink (`ros_unit`, `igtl_unit`, also
            for single streams).  Patient coordinates are RAS; LPS is converted.  Values of SENSOR keep their unit;
            names, strings and pixels are not changed.

            The users' metadata is part of the messages of `igtl_msgs`.  If a message is converted to standard
            messages only, its metadata is published beside them, on `/igtl/in/<device>/metadata` as
            `igtl_msgs/Metadata`.  Rows `[[to_igtl]]` can add metadata."""
        ),
    ).rstrip()


def _to_ros() -> str:
    return document(
        "## OpenIGTLink to ROS",
        prose(
            """One message can be converted to several.  *standard*: a message type of ROS itself.  *full*: a type of
            `igtl_msgs` for what the standard types cannot represent.  *on request*: published if a row `[[to_ros]]`
            names its kind, as in `kinds = ["+slices"]`.  *depth*: of the publisher's queue (reliable, volatile);
            *latched*: late joiners receive the last messages too (transient-local).  Messages of types without a
            conversion are published on `/igtl/in/<device>/raw` as `igtl_msgs/RawMessage`.  The children of a BIND
            are also converted as if each had been sent alone.  The parts of an IMAGE are converted as one image when it
            is complete.  `/igtl/links` lists the connected peers as `igtl_msgs/LinkStatusList`."""
        ),
        *(f"### {title}\n\n{_ros_table(rows)}" for title, rows in ros_sections().items()),
    ).rstrip()


def _ros_table(rows: Sequence[ConversionToRos]) -> str:
    """Rows that differ in nothing but kind and type of numbers share a line."""
    groups: dict[tuple[object, ...], list[ConversionToRos]] = {}
    for row in rows:
        key = (row.convert, row.qos, row.lossy, row.role, _condition(row))
        groups.setdefault(key, []).append(row)
    lines = []
    for group in groups.values():
        row = group[0]
        condition = _condition(row) if len({one.applies for one in group}) == 1 else "if its numbers are of that type"
        lines.append(
            (
                "<br>".join(f"`{one.topic or one.kind}`" for one in group),
                "<br>".join(ros_name(one.message.TYPE) for one in group),
                row.role.value + (f", {condition}" if condition else ""),
                _keeps(row.qos),
                row.lossy or "–",
            )
        )
    order = {role.value: number for number, role in enumerate(Role)}
    lines.sort(key=lambda line: order[line[2].partition(",")[0]])
    return table(("kind", "ROS", "published", "depth", "lost"), lines)


def _condition(row: ConversionToRos) -> str:
    """When a row applies, by the docstring of the function that knows."""
    applies = row.applies
    if applies is ConversionToRos.__dataclass_fields__["applies"].default:
        return ""
    outer, _, inner = applies.__qualname__.partition(".")
    told = inspect.getdoc(applies) or (inspect.getdoc(applies.__globals__.get(outer)) if inner else "") or ""
    if told:
        first = (
            " ".join(told.partition("\n\n")[0].split())
            .removeprefix("Return whether ")
            .removeprefix("Whether ")
            .rstrip(".")
            .replace("``", "`")
        )
        return "if " + (first if first[1].isupper() else f"{first[0].lower()}{first[1:]}")
    return "in some cases" if "<" in outer else f"if it {outer.replace('_', ' ')}"


def _keeps(qos: Qos) -> str:
    extra = (", latched" if qos.latched else "") + ("" if qos.reliable else ", best effort")
    return f"{qos.depth}{extra}"


def _to_igtl() -> str:
    defaults = {row.message: row for row in reversed(TO_IGTL)}
    groups: dict[tuple[object, ...], list[ConversionToIgtl]] = {}
    for row in TO_IGTL:
        is_default = defaults[row.message] is row
        groups.setdefault((row.convert, row.qos, row.lossy, is_default), []).append(row)
    lines = []
    for same in groups.values():
        row = same[0]
        # the type of a query is the message's own choice
        sent = "`GET_…` `STT_…` `STP_…` `RTS_…`" if split_query(row.igtl_type) else f"`{row.igtl_type}`"
        lines.append(
            (
                "<br>".join(ros_name(one.message.TYPE) for one in same),
                sent + ("" if defaults[row.message] is row else " on request"),
                _keeps(row.qos),
                row.lossy or "–",
            )
        )
    # the default of a type first, then the others
    lines.sort(key=lambda line: (line[0].lstrip("[").lower(), "on request" in line[1], line[1]))
    return document(
        "## ROS to OpenIGTLink",
        prose(
            """*on request*: if a row `[[to_igtl]]` names this `type`, or a peer requests it.  *depth*: of the
            subscription's queue; the last message of a *latched* topic is re-sent to late joiners.  A complete
            message of any type is sent unchanged as `igtl_msgs/RawMessage`.  A COMMAND is stored until its reply
            or its timeout."""
        ),
        table(("ROS", "OpenIGTLink", "depth", "lost"), lines),
    ).rstrip()


def _definitions() -> str:
    rows = []
    for path in sorted(DEFINITIONS.glob("*/*.[ms][sr][gv]"), key=lambda path: (path.suffix, path.stem)):
        first = path.read_text("utf-8").partition("\n")[0].removeprefix("# ").rstrip(".")
        place = path.relative_to(ROOT).as_posix()
        rows.append((f"[{path.stem}](../../{place})" + (" (service)" if path.suffix == ".srv" else ""), first))
    return document(
        "## igtl_msgs",
        prose(
            """[igtl_msgs](../../ros2/igtl_msgs/README.md) has message types that the standard packages do not have.
            The definitions describe each field."""
        ),
        table(("definition", "content"), rows),
    ).rstrip()


# -- docs/reference/doctor.md -----------------------------------------------------------------------------------------

#: First digit of a rule's number → what its rules are about.
GROUPS = {
    "1": "Links",
    "2": "Headers and bodies",
    "3": "Stamps",
    "4": "Names",
    "5": "Content",
    "6": "ROS",
    "7": "The recording",
    "8": "Notes",
}


DOCTOR_EXAMPLES = """\
igtl-gateway doctor 192.168.1.20:18944        # connect to that server for 5 seconds
igtl-gateway doctor --listen :18944           # listen, and wait for a client
igtl-gateway doctor --listen :18944 10.0.0.7  # the same; also check whether that host has a server
igtl-gateway doctor tls://or1.clinic --tls-cert me.pem --tls-ca clinic.pem    # connect to a server with TLS
igtl-gateway doctor :18944 --ros              # check the ROS graph too
igtl-gateway doctor --host                    # check this machine for causes of jitter
igtl-gateway lint out.mcap                    # check a recording"""


def doctor() -> str:
    """docs/reference/doctor.md."""
    return document(
        "# Diagnosis: `doctor` and `lint`",
        GENERATED,
        prose(
            """`doctor` connects to a peer, observes its messages and reports the probable cause if nothing
            arrives.  `lint` applies the same rules to a recording."""
        ),
        textwrap.indent(DOCTOR_EXAMPLES, "    "),
        prose(
            """Both print the peers, each stream with its rate, CRC and stamps, and the findings.  The last line is the
            most important finding.  `--json` prints all of it as one object: `cause`, `nothing_arrives`, `findings`
            (`id`, `severity`, `where`, `text`, `advice`, `section`, `data`), `peers`, `streams`.  Exit code 0: no
            finding is an error; 1: at least one is; 2: wrong usage.  `--config FILE` reads units, devices and topics
            from a bridge's configuration.  `--seconds` and `--messages` limit the observation.  For TLS, see
            [security.md](../how-to/security.md)."""
        ),
        "## The rules",
        prose(
            """The letter is the severity: E, messages are lost or wrong; W, messages arrive but might mislead; I,
            information.  A number never changes its meaning."""
        ),
        *(
            f"### {title}\n\n{_rules([rule for rule in RULES if rule.id[6] == digit])}"
            for digit, title in GROUPS.items()
        ),
        prose(
            """If several rules apply, the cause is the first one in this order, errors before warnings: """
            + ", ".join(rule.id.removeprefix("IGTL-") for rule in RULES)
            + "."
        ),
        "## Roles",
        prose(
            """One side must listen and the other must connect.  If there is no link after half of the time, `doctor`
            takes the other role: as a client without a server it listens on the same port; as a server without a
            client it connects to the address given after the options, or to the program that already uses the port.
            So it distinguishes two clients and two servers from a missing peer.  It listens on loopback only, unless
            `--allow` names a network."""
        ),
        "## Silence",
        prose(
            """If a peer has sent nothing after half of the time, `doctor` sends one STATUS (code 1, device
            `igtl_doctor`), which every program accepts.  A bridge of igtl-gateway replies to it with the STATUS
            `igtl_gateway` (IGTL-I117), and forwards it neither to ROS nor to peers.  The STATUS ends with an empty
            line, so that a web server answers too.  `--speak 2` sends it with header version 2, `--speak 0` disables
            it.  `doctor` sends nothing else, and never a query: some queries crash 3D Slicer.  In a recording, a silent
            peer is not a finding, because it might be a display."""
        ),
        "## Other protocols",
        prose(
            """Recognised by their first bytes: """
            + ", ".join(name for name, _ in PROTOCOLS)
            + """.  Other bytes without a type name in the header are reported as an unknown protocol.  The same
            happens in the middle of a stream if an earlier size was wrong."""
        ),
        "## Units",
        prose(
            f"""A tracked object is at least some centimetres away from the tracker.  Therefore, if all poses of a
            moving object are within {checks.SMALL_MM:g} mm of the origin, their unit is probably metres; beyond
            {checks.LARGE_MM / 1000:g} m, a factor was probably applied twice.  This is a guess: a small moving offset
            is reported too.  The rule does not apply if the configuration has `igtl_unit = "m"`."""
        ),
        "## ROS graph",
        prose(
            """With `--ros`, a node `igtl_doctor` joins the graph; it publishes nothing and subscribes to nothing.
            `doctor` takes the topics that the gateway would publish for the observed messages, and those below
            `/igtl/in/` and `/igtl/out/`.  It compares them with the existing publishers and subscribers, including
            those of a running bridge: type, reliability and durability.  The bridge's own subscriptions adapt to the
            publishers."""
        ),
        "## Rates",
        prose(
            f"""A pause is reported if it is longer than {checks.GAP_FACTOR} mean intervals and longer than a second, in
            streams of at least {checks.MIN_MESSAGES} messages."""
        ),
        "## The machine",
        prose(
            f"""`doctor --host` checks the machine on which it runs, without a peer.  It takes two seconds and changes
            no setting.  Each finding has what was found, what is expected and how to get it.  Then follow the checks
            without a problem, and those whose fact the system does not show: a virtual machine has no CPU frequency,
            and some facts are for root only.  Limits and CPUs are those of `doctor` itself, so run it as the same
            user, in the same container and from the same service manager as the bridge.

            The measurement has two parts.  A thread sleeps {host_probe.SLEEPS:,} times for 1 ms, and each delay of its
            wake-up counts, as in cyclictest.  Two threads hand over to each other {host_probe.HANDOVERS:,} times, and
            half of each round trip counts.  Both use Python's locks, as the bridge does, without a real-time priority.

            `--json` prints one object: `checks` (`id`, `severity`, `title`, `status`: `ok`, `finding` or `unknown`,
            `found`, `expected`, `advice`, `section`) and `measured` (`lateness` and `handover` in nanoseconds;
            `steal`, a share of the time).  No check is an error, because the bridge runs on every machine.  So the exit
            code is 0.  For the options of the bridge, see
            [performance.md](../evidence/performance.md#priority-memory-and-cpus)."""
        ),
        table(
            ("check", "subject", "expected", "how to get it"),
            [(f"`{row.id}`", row.title, row.expected, row.advice) for row in host_checks.HOST_CHECKS],
        ),
        "## Limits",
        prose(
            f"""At most {MAX_STREAMS:,} streams and {MAX_STREAMS:,} links are checked.  `doctor` decodes every
            message and tries every conversion, so it can be slower than a bridge; then the peer has to wait."""
        ),
    )


def _rules(rules: Sequence[Rule]) -> str:
    rows = [
        (f"`{rule.id}`", rule.title, rule.advice, _section(rule.section))
        for rule in sorted(rules, key=lambda rule: rule.id[6:])
    ]
    return table(("rule", "finds", "what to do", "see"), rows)


def _section(section: str) -> str:
    """The place as a link."""
    place, _, title = section.partition(": ")
    if place.startswith("Protocol/"):
        name = place.removeprefix("Protocol/")
        return f"[{name}]({DOCUMENTS}/{name})" + (f", {title}" if title else "")
    name = place.rpartition("/")[2]
    if name == "doctor.md":
        return f"[{title}](#{anchor(title)})"
    return f"[{title or name}]({posixpath.relpath(place, 'docs/reference')}" + (f"#{anchor(title)})" if title else ")")


# -- command line -----------------------------------------------------------------------------------------------------


def verbs() -> str:
    """docs/reference/verbs.md."""
    return document(
        "# Options of all verbs",
        GENERATED,
        prose(
            """`igtl-gateway VERB --help` prints the same in the terminal. [command-line.md](command-line.md) describes
            what all verbs have in common, such as the exit codes."""
        ),
        "\n".join(f"* [{name}](#{name}): {verb.help}" for name, verb in available().items()),
        *(_verb(name, verb) for name, verb in available().items()),
    )


def _verb(name: str, verb: Verb) -> str:
    parser = argparse.ArgumentParser(f"igtl-gateway {name}", add_help=False)
    complete(parser, verb)
    parts = []
    for group in parser._action_groups:
        rows = [_option(action) for action in group._group_actions if action.help != argparse.SUPPRESS]
        if rows:
            title = "arguments" if group.title == "positional arguments" else str(group.title)
            parts.append(table((title, "meaning", "default"), rows))
        if group.description:
            parts.append(fenced(group.description))
    return document(f"## {name}", str(parser.description), *parts, fenced(str(parser.epilog))).rstrip()


def fenced(text: str) -> str:
    return f"```text\n{text.strip()}\n```"


def _option(action: argparse.Action) -> tuple[str, str, str]:
    """Name with metavar, meaning and default of an option; ``options.default`` wrote the default."""
    metavar = argument_name(action)
    match action.nargs:
        case 0:
            metavar = ""
        case "?" if action.option_strings:
            metavar = f"[{metavar}]"
        case "+":
            metavar = f"{metavar} …"
    names = ", ".join(action.option_strings)
    text, _, default = (action.help or "").replace("%%", "%").partition(" (default: ")
    return f"`{f'{names} {metavar}'.strip()}`", _escape(text), _escape(default.removesuffix(")"))


def _escape(text: str) -> str:
    return text.replace("*", "\\*").replace("<", "\\<")


# -- notes and topics -------------------------------------------------------------------------------------------------


def notes() -> str:
    """docs/reference/notes.md."""
    groups = []
    for group, codes in NOTES.items():
        rows = ((f"`{code}`", text) for code, text in codes.items())
        groups += [f"## {group}", table(("code", "what has happened"), rows)]
    return document(
        "# Notes and their codes",
        GENERATED,
        prose(
            """A note is a fact about the session besides its messages: a link, a drop, a rejected message.  The bridge
            prints notes and records them on `/igtl_gateway/notes`; `/diagnostics` shows the states behind them.  The
            code of a note is stable, so that programs can rely on it; its text is for people and may change.
            `igtl-gateway info FILE` shows the notes that are problems."""
        ),
        *groups,
    )


def topics() -> str:
    """docs/reference/topics.md."""
    kinds: dict[tuple[str, str], list[str]] = {}
    fixed: dict[tuple[str, str], list[str]] = {}
    for row in TO_ROS:
        names = [name for name in row.igtl_types if name not in ALIASES]
        place = (fixed, row.topic) if row.topic else (kinds, f"/igtl/in/<device>/{row.kind}")
        place[0].setdefault((place[1], ros_name(row.message.TYPE)), []).extend(names)
    published = [
        *((f"`{topic}`", kind, code(_queries_as_one(types))) for (topic, kind), types in sorted(kinds.items())),
        *((f"`{topic}`", kind, code(dict.fromkeys(types))) for (topic, kind), types in sorted(fixed.items())),
    ]
    return document(
        "# Topics and services",
        GENERATED,
        prose(
            """The node `/igtl_gateway` has these topics and services.  `~` is the name of the node.  A configuration
            can give a device other topics (`[[to_ros]]`), and can send any topic (`[[to_igtl]]`);
            [conversions.md](conversions.md) describes the conversions, and which kinds are published on request."""
        ),
        "## Published",
        table(("topic", "ROS type", "from OpenIGTLink"), published),
        table(
            ("topic", "ROS type", "content"),
            (
                ("`/igtl/in/<device>/metadata`", ros_name("igtl_msgs/msg/Metadata"), "metadata of header version 2"),
                ("`/igtl/in/<device>/raw`", ros_name("igtl_msgs/msg/RawMessage"), "messages without a conversion"),
                (f"`{LINKS_TOPIC}`", ros_name("igtl_msgs/msg/LinkStatusList"), "the connected peers; latched"),
                (f"`{DIAGNOSTICS_TOPIC}`", "diagnostic_msgs/DiagnosticArray", "state of streams, peers and recorder"),
            ),
        ),
        "## Subscribed",
        table(
            ("topic", "content"),
            (
                ("`/igtl/out/**`", "sent to the peers as the device that the rest of the name gives"),
                ("topics of `--send` and `[[to_igtl]]`", "sent to the peers"),
                ("`/tf`, `/tf_static`", "only for `--tf-out` and `[[tf_out]]`"),
                ("topics of `--record-topics`, `--record-all`", "recorded, not sent"),
            ),
        ),
        "## Services",
        table(
            ("service", "type", "effect"),
            (
                (f"`{SERVICE}`", "igtl_msgs/SendCommand", "send a COMMAND to a peer and wait for its reply"),
                (f"`{PAUSE}`, `{RESUME}`", TRIGGER, "pause and resume the recording"),
                (f"`{SNAPSHOT}`", TRIGGER, "with `--snapshot`: write the last seconds to a file"),
            ),
        ),
        "`igtl-gateway replay --to ros` has the services of `ros2 bag play`, if rosbag2_interfaces is installed.",
        "## In recordings only",
        table(
            ("topic", "ROS type", "content"),
            (
                ("`/igtl_gateway/wire/in/<type>/<device>`", ros_name("igtl_msgs/msg/RawMessage"), "received bytes"),
                ("`/igtl_gateway/wire/out/<type>/<device>`", ros_name("igtl_msgs/msg/RawMessage"), "sent bytes"),
                ("`/igtl_gateway/notes`", ros_name("igtl_msgs/msg/Note"), "[notes](notes.md)"),
            ),
        ),
    )


def _queries_as_one(types: Iterable[str]) -> list[str]:
    """Names without repetition; the queries, which are many, by their prefixes."""
    return list(dict.fromkeys(re.sub(r"_.*", "_…", name) if name in QUERIES else name for name in types))


# -- docs/reference/parameters.md -------------------------------------------------------------------------------------

_SETTING_TYPES: dict[type, str] = {bool: "bool", int: "integer", float: "double", str: "string", tuple: "strings"}


def node_parameters() -> str:
    """docs/reference/parameters.md."""
    return document(
        "# Parameters of the node",
        GENERATED,
        prose(
            """`igtl-gateway bridge` is a ROS 2 node with the name `/igtl_gateway`. All its settings are
            parameters, with the names of the keys of the configuration file. `ros2 param list` and
            `ros2 param describe` show them while the bridge runs."""
        ),
        fenced(
            """ros2 run igtl_gateway bridge --ros-args --params-file or1.yaml -p stall_s:=5.0 \\
    -r __ns:=/or1 -r __node:=gw -r /camera/image:=/microscope/image --log-level warn
ros2 param set /or1/gw deny_in "['COMMAND']" """
        ),
        prose(
            """Everything from `--ros-args` on belongs to ROS, up to `--` or to the end. `igtl-gateway bridge
            --ros-args …` is the same without `ros2 run`."""
        ),
        "## Where a value comes from",
        prose(
            """A setting has the value of the command line; else that of its parameter (`-p`, `--params-file`,
            launch file); else that of the configuration file (`--config`, or the parameter
            `config`); else its default. Among the parameters, the section of a file with the full
            name of the node applies before `-p`, and `-p` before the section `/**`: that is the
            order of ROS.

            `--deny-in`, `--deny-out`, `--send`, `--tf-out`, `--kinds` and `--peer` add to the lists of the
            parameters or of the file. All other settings are replaced.

            A wrong value has the same message in a file, on the command line and in the answer of `ros2 param set`,
            such as `stall_s: found 0, expected 0.001 to 31536000`. A wrong value or an unknown name ends the start:
            a deny list with a wrong name must not pass unnoticed. So write parameters of other nodes below the
            names of these nodes.

            An integer is accepted for a double. `[]` is an empty list of strings."""
        ),
        "## While the bridge runs",
        prose(
            f"""{code(row.name for row in SETTINGS if row.changes)} can change. A change is an input of the session,
            so the recording verifies ([lifecycle.md](../how-to/lifecycle.md)). All other parameters are
            read-only. Pause, resume and snapshot of a recording are services: `~/pause_recording`,
            `~/resume_recording`, `~/snapshot`."""
        ),
        "## Rows of messages",
        prose(
            f"""{code(of_table(ROWS))} are tables in a configuration file. As parameters they are lists of strings,
            one for each row. A row is written as its option has it, such as `/camera/image=Camera`,
            or as a JSON object with the keys of the table. One string for each row keeps a row
            together, and it has all keys; lists of single columns would have to be of one length.
            `ros2 param get` shows all rows as JSON objects, also those of a file."""
        ),
        fenced(
            """/**:
  ros__parameters:
    to_igtl: ["/camera/image=Camera", '{"topic": "/arm/pose", "device": "Arm", "max_age_s": 0.5}']
    tf_out: ["tool0:base_link"]"""
        ),
        "## Names of topics",
        prose(
            """Remapping works for all topics and services, in Python and in the native passage. In a namespace,
            topics below `/igtl/` move into it: with `-r __ns:=/or1`, messages of a device are
            published on `/or1/igtl/in/<device>/<kind>`, and messages on `/or1/igtl/out/<device>`
            are sent to the peers. So two bridges in two namespaces have separate topics. Absolute
            topics of other names, such as `/tf`, `/diagnostics` and those in rows of messages,
            stay, as in all nodes; `-r /tf:=tf -r /tf_static:=tf_static` moves the poses into the
            namespace. Two bridges whose peers have the same device names need that, because frames
            are named after devices: the launch file `two_bridges` does it, and a bridge in a
            namespace without it reports so at its start. The statuses on `/diagnostics` begin with
            the name of the node and its namespace.

            **The configuration and the recording have the names before remapping**, such as
            `/igtl/in/<device>/<kind>`. A session then depends only on its configuration: `verify` and `replay` need
            no rules, and a replay can have other rules or none. The metadata of a recording has the command line
            with the rules (`info`). Topics that are recorded only (`record_topics`) and that no rule names have
            their names in the graph."""
        ),
        "## Log",
        prose(
            """`/rosout` has what the terminal shows: all states, and the first warning and error of each cause,
            with their levels. `--log-level` and the service `~/set_logger_levels` set the lowest
            level of `/rosout` and of the terminal. The recording has all notes. It does not have
            `/rosout`."""
        ),
        "## All parameters",
        prose(
            """*table*: the table of the configuration file; without one, the setting is an option and a parameter.
            A setting without a mark in *changes* is read-only while the bridge runs. `relay`,
            `faults` and `fault_seed` are not in the table: a relay has no node."""
        ),
        table(
            ("parameter", "type", "default", "range", "meaning", "option", "table", "changes"),
            [
                (
                    f"`{row.name}`",
                    _SETTING_TYPES[type(row.default)],
                    _default(row),
                    _escape(constraints(row)),
                    _escape(description(row)),
                    f"`{row.flag}`" if row.flag else "",
                    {ROWS: f"`[[{row.name}]]`", "": ""}.get(row.table, f"`[{row.table}]`"),
                    "yes" if row.changes else "",
                )
                for row in SETTINGS
                if row.parameter
            ],
        ),
    )


def _default(row: Setting) -> str:
    """The default as in a file of parameters."""
    if row.shown and not row.default:
        return description(replace(row, about=row.shown))
    return json.dumps(list(row.default) if isinstance(row.default, tuple) else row.default)


# -- docs/how-to/deidentify.md ----------------------------------------------------------------------------------------


def deidentification() -> str:
    """docs/how-to/deidentify.md."""
    rules = table(("rule", "place", "what happens", "action", "option"), deidentify_page.rows())
    options = table(("option", "name in DICOM PS3.15"), deidentify_page.options())
    return document(deidentify_page.TITLE, GENERATED, deidentify_page.text(rules, options))


# -- files ------------------------------------------------------------------------------------------------------------

PAGES = {
    "reference/conversions.md": conversions,
    "how-to/deidentify.md": deidentification,
    "reference/doctor.md": doctor,
    "reference/messages.md": messages,
    "reference/parameters.md": node_parameters,
    "reference/notes.md": notes,
    "reference/topics.md": topics,
    "reference/verbs.md": verbs,
}


def stale(folder: Path = DOCS) -> list[str]:
    """Names of the files in ``folder`` that are not as the tables have it."""
    paths = {name: folder / name for name in PAGES}
    return [name for name, path in paths.items() if not path.exists() or path.read_text("utf-8") != PAGES[name]()]


def main(arguments: Sequence[str], folder: Path = DOCS) -> int:
    """Write the files, or with ``--check`` compare; 1 where they differ."""
    old = stale(folder)
    if list(arguments) == ["--check"]:
        for name in old:
            print(f"docs/{name} is not as the tables have it: python tools/docs.py", file=sys.stderr)
        return 1 if old else 0
    for name in old:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(PAGES[name](), "utf-8")
        print(f"docs/{name}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
