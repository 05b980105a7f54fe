"""One of a thing is no plural: counts in sentences are made by ``count_text`` and ``counted``.

Strategy: in the f-strings of the sources no value stands in front of one of the usual plurals.  Constants are never 1;
values that are words, or more than one wherever the line is printed, are listed.
"""

from __future__ import annotations

import re

from tests.places import FIXTURES

ROOT = FIXTURES.parent
#: Messages that scenarios send; replays compare them byte by byte.
_SENT = ("lab/igtl_gateway_lab/simulate", "lab/igtl_gateway_lab/demo")
_NOUNS = (
    "bytes messages values points numbers frames entries rows streams joints characters elements peers axes "
    "poses slices samples recordings links files connections components windows tools stitches positions "
    "parameters packets items fields cells bodies bits attributes vectors units names tuples transforms "
    "trajectories steps servers parts pairs meshes marks labels images pictures fragments episodes digits "
    "demonstrations cores commits columns clouds clients chunks children channels buttons pieces matrices "
    "outputs inputs nodes topics devices sessions programs findings warnings errors types notes differences "
    "records gaps keys patients workers threads options"
).split()
#: A value of an f-string and a plural behind it, with an adjective between them.
_COUNT = re.compile(r"(?<![x×] )\{([^{}]+?)(?::,)?\} ((?:[a-z]+ )?)(?:" + "|".join(_NOUNS) + r")\b(?![-/=])")
#: Words that are not adjectives.
_OTHERS = set(
    "of in to from by with for at as and or is are has have sends does than no the a not sent per after before without "
    "if states that these its their needs moves shows takes more".split()
)
_CONSTANT = re.compile(r"\b_*[A-Z][A-Z0-9_]{2,}\b|by_count\(")
#: Values that are words, or never 1 where they are printed.
NOT_ONE = {
    "joint.kind", "message.encoding", "frame.codec", "len(having)", "receivers", "there", "peers", "name[2]",
    "size[0]", "short(rhythms[0].rate_hz)", "found[0]", "one.lengths.positions", "one.timing.stamped", "way",
    "theirs", "rows", "track.name", "row", "each", "_sizes_text([components])", "_short(lengths[0])",
    "_leaves(table[name])", "place", "wanted", "found", "key", "str(size)[:20]", "str(inner[1])[:20]",
    "len(options.files)", "len(paths)", "_name(packed)", "_name(count)", "peer", "data['expected'] or '?'",
}  # fmt: skip


def counts_before_plurals(text: str) -> list[str]:
    """Return what is found in a source."""
    return [
        match[0]
        for match in _COUNT.finditer(text)
        if match[1] not in NOT_ONE
        and match[2].strip() not in _OTHERS
        and not _CONSTANT.search(match[1])
        and "by_count(" not in match[1]
    ]


def test_no_count_stands_before_a_plural() -> None:
    found = []
    for path in sorted((*ROOT.glob("igtl_gateway/**/*.py"), *ROOT.glob("lab/**/*.py"))):
        name = path.relative_to(ROOT).as_posix()
        if not name.startswith(_SENT):
            text = path.read_text("utf-8")
            found += [f"{name}: {each}" for each in counts_before_plurals(text)]
            found += [f"{name}: {each}" for each in re.findall(r"\} \w+\(s\)", text)]
    assert not found


def test_a_count_before_a_plural_is_found() -> None:
    for text in ('f"found {len(data)} bytes"', 'f"{number:,} input streams"', "f'{one.count} messages of'"):
        assert counts_before_plurals(text), text
    assert not counts_before_plurals("f\"{counted(n, 'byte')} of {MOST} bytes, {width} x {height} pixels\"")
