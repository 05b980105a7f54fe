"""Check the words of documents, docstrings, comments, messages and help against the rules (docs/reference/style.md).

    .venv/bin/python tools/terms.py              check all files
    .venv/bin/python tools/terms.py PATH …       check these files and folders

Strategy: extract the prose of each tracked file, then search it for the terms of one table.  Code between backquotes,
fenced blocks of Markdown, identifiers and strings of a single word are not prose.  A term that a file needs, because it
quotes somebody or is about the word itself, is a row in ``EXCEPTIONS``.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

#: Term (regular expression, any case unless it sets its own; a space matches any white space) → what to write instead.
TERMS = {
    r"tell|tells|telling|told": "reports, sends, shows; distinguishes",
    r"say|says|saying|said": "sends, publishes, reports, logs; states (of a document)",
    r"hear|hears|hearing|heard|unheard": "receives, subscribes to",
    r"nobody|somebody|anybody|whoever": "no subscriber, no peer; another program; any client",
    r"goodbye|goodbyes": "orderly close",
    r"stranger|strangers": "unknown program, untrusted input",
    r"guest|guests": "peer, client",
    r"calm|calmly|calmed|hurry|hurries|hurried": "idle; busy; raises or lowers the priority",
    r"obey|obeys|obeyed": "applies, handles",
    r"wish|wishes|wished": "request, option",
    r"believe|believes|believed": "accepts, trusts",
    r"mend|mends|mended": "repairs, fixes",
    r"anew": "again",
    r"by turns": "alternately, round-robin",
    r"on purpose": "deliberately; fault injection",
    r"(?:on|of) its own account": "itself",
    r"for ever": "forever, until stopped",
    r"without a word|words? of its own|last words": "silently; message; last output",
    r"(?-i:(?<!there\s)(?:is|are|was|were) none)": "is not one, is invalid",
    r"(?:that|which|it|they) (?:is|are) no (?!longer\b|more\b|less\b|better\b|worse\b)\w+": "is not a …, is invalid",
    r"(?:is|are) no more(?! than\b)|(?:has|have|had) gone": "has ended, is disconnected",
    r"held against|holds? against|holding against|hold each other|holds? them against": "is compared with",
    r"let go|lets go|letting go": "releases",
    r"at rest|rests": "idle; stays uncompressed",
    r"stands? still|stood still|standing still": "does not change",
    r"runs? backwards?|running backwards?|ran backwards?": "decreases",
    r"so many(?! (?:\w+ )?that\b)|so often|so long (?:after|before|may|a|no|until)": "the given number or time",
    r"bec[ao]mes? of": "the result of",
    r"as (?:it|they) came": "as received",
    r"that day|today's gateway": "the recorded …; this version",
    r"is made of (?:it|them)": "is the result",
    r"costs? itself": "only this message is rejected",
    r"whole numbers?": "integer",
    r"a text|texts": "a string, strings; text",
    r"no (?:UTF-8|JSON|YAML|TOML|ASCII)": "not …, invalid …",
    r"of ours": "our, own, internal",
    r"but for": "except",
    r"see(?:s|n)? to(?: it)?": "ensures; handles",
    r"bent messages?|bent bytes": "mutated messages",
    r"greets?": "sends first",
    r"as said": "as described",
    r"(?:peer|gateway|bridge|viewer|reader|client|server|recorder|node|side|program|it) wants": "needs, requests",
}  # fmt: skip

#: Path or folder → the terms that its prose may have, with the reason.
EXCEPTIONS = {
    "igtl_gateway/config/note_codes.py": "calm",  # a code of recordings
    "docs/reference/style.md": r".*",  # its table has them
    "igtl_gateway/addon/ros_side.py": "heard",  # a name of the code
    "tools/terms.py": r".*",
    "tests/test_terms.py": r".*",
    "tools/docs.py": r"whole numbers?",
    "igtl_gateway/gateway/dialogue/commanding.py": r"has gone",  # text of a reply: recordings verify by its bytes
}

_TERM = re.compile(
    rf"\b(?:{'|'.join(rf'(?P<t{at}>{term})' for at, term in enumerate(TERMS))})\b".replace(" ", r"\s+"), re.IGNORECASE
)
#: The same in source code, where a phrase might continue in the next comment or string.
_SOURCE = re.compile(_TERM.pattern.replace(r"\s+", r"[\s#:\"'f]+"), re.IGNORECASE)
_INSTEAD = list(TERMS.values())
#: What is quoted as code, or as a link's address.
_CODE = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)|\]\([^)\s]*\)|<!--.*?-->|https?://\S+", re.DOTALL)
#: Blocks of code, fenced or indented by four spaces.
_FENCE = re.compile(r"^( *)(```|~~~).*?^\1\2 *$|^ {4}[^\n]*$", re.DOTALL | re.MULTILINE)
_C_PROSE = re.compile(r"/\*.*?\*/|//[^\n]*|\"(?:[^\"\\\n]|\\.)*\"", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Found:
    """A term in the prose of a file."""

    path: str
    line: int
    term: str
    instead: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: found {self.term!r}, write instead: {self.instead}"


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def _comments_only(match: re.Match[str]) -> str:
    """A block of code, without everything but its line ends and the comments of shell commands."""
    return "\n".join(line.partition(" # ")[2] for line in match[0].split("\n"))


def markdown(text: str) -> Iterator[tuple[int, str]]:
    yield 1, _FENCE.sub(_comments_only, text)


def python(text: str) -> Iterator[tuple[int, str]]:
    """Comments, one item for a block of lines, docstrings, and strings of several words."""
    block: list[str] = []
    first = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if block and token.start[0] != first + len(block):
                yield first, "\n".join(block)
                block = []
            first = token.start[0] - len(block)
            block.append(token.string.lstrip("#: "))
    yield first, "\n".join(block)
    parts: set[int] = set()
    for node in ast.walk(ast.parse(text)):  # an f-string comes before its parts
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            prose = "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            prose = node.value
        else:
            continue
        if " " in prose.strip():
            yield node.lineno, prose


def c(text: str) -> Iterator[tuple[int, str]]:
    for match in _C_PROSE.finditer(text):
        if " " in match[0]:
            yield text.count("\n", 0, match.start()) + 1, match[0]


PROSE: dict[str, Callable[[str], Iterator[tuple[int, str]]]] = {".md": markdown, ".py": python, ".c": c}


def check(path: str, text: str) -> Iterator[Found]:
    """The terms in the prose of a file; ``path`` relative to the repository decides language and exceptions."""
    if not _SOURCE.search(text):  # spares parsing the file
        return
    allowed = [re.compile(terms, re.IGNORECASE) for place, terms in EXCEPTIONS.items() if path.startswith(place)]
    for first, prose in PROSE[Path(path).suffix](text):
        plain = _CODE.sub(_blank, prose)
        for match in _TERM.finditer(plain):
            term = " ".join(match[0].split())
            if not any(each.fullmatch(term) for each in allowed):
                line = first + plain.count("\n", 0, match.start())
                yield Found(path, line, term, _INSTEAD[int(str(match.lastgroup)[1:])])


def tracked(paths: Iterable[str] = ()) -> list[str]:
    """The files of the repository that have prose, all or those at ``paths``."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--", *paths], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    return [path for path in listed if Path(path).suffix in PROSE and (ROOT / path).is_file()]


def main(args: Sequence[str] | None = None) -> int:
    paths = list(sys.argv[1:] if args is None else args)
    found = [each for path in tracked(paths) for each in check(path, (ROOT / path).read_text("utf-8"))]
    for each in found:
        print(each)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
