"""``tools/docs.py``: the documents are current, complete and whole."""

from __future__ import annotations

import ast
import re
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from igtl_gateway.config.note_codes import NOTE_CODES
from igtl_gateway.convert.profiles import PROFILES
from igtl_gateway.convert.table import TO_IGTL, TO_ROS
from igtl_gateway.doctor import RULES
from igtl_gateway.doctor.host_checks import HOST_CHECKS
from igtl_gateway.gateway import metadata
from igtl_gateway.wire.layout import Field
from igtl_gateway.wire.query import QUERY_ALIASES
from igtl_gateway.wire.registry import BODIES
from tests.places import ROOT
from tools import docs
from tools.note_codes import NOTES

# Not on import, which is in every worker: counting what conforms takes a second.
messages, conversions, doctor = cache(docs.messages), cache(docs.conversions), cache(docs.doctor)


@pytest.fixture(
    params=[messages, conversions, doctor, docs.notes, docs.topics],
    ids=["messages", "conversions", "doctor", "notes", "topics"],
)
def page(request: pytest.FixtureRequest) -> str:
    return str(request.param())


def anchors(page: str) -> set[str]:
    return {docs.anchor(title) for title in re.findall(r"^#+ (.*)$", page, re.MULTILINE)}


def section(page: str, title: str) -> str:
    """What stands below a heading of the third level."""
    return page.partition(f"\n### {title}\n")[2].partition("\n### ")[0]


def test_the_files_are_current() -> None:
    assert docs.stale() == [], "python tools/docs.py"


def test_what_is_written_is_current_and_what_is_changed_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert docs.main(["--check"], tmp_path) == 1
    assert list(tmp_path.iterdir()) == []
    assert docs.main([], tmp_path) == 0
    assert docs.main(["--check"], tmp_path) == 0
    (tmp_path / "reference" / "messages.md").write_text(messages().replace("TDATA", "TDATUM"), "utf-8")
    capsys.readouterr()
    assert docs.main(["--check"], tmp_path) == 1
    assert "docs/reference/messages.md" in (said := capsys.readouterr().err)
    assert "conversions" not in said


def test_every_type_profile_and_key_is_there() -> None:
    assert [name for name in BODIES if f"`{name}`" not in messages() and name not in QUERY_ALIASES] == []
    assert [profile.name for profile in PROFILES if f"### Profile {profile.name}\n" not in messages()] == []
    facts = [fact.replace("|", "\\|") for profile in PROFILES for fact, _ in profile.facts]
    assert [fact for fact in facts if fact not in messages()] == []
    assert docs.KEYS.keys() == metadata.OURS


def test_every_conversion_is_there() -> None:
    for to_ros in TO_ROS:
        here = section(conversions(), next(title for title, rows in docs.ros_sections().items() if to_ros in rows))
        for fact in (f"`{to_ros.topic or to_ros.kind}`", docs.ros_name(to_ros.message.TYPE), to_ros.lossy):
            assert fact in here
    back = conversions().partition("## ROS to OpenIGTLink")[2]
    for to_igtl in TO_IGTL:
        name = docs.ros_name(to_igtl.message.TYPE)
        lines = [line for line in back.splitlines() if name in line and to_igtl.lossy in line]
        wanted = "`GET_…`" if to_igtl.igtl_type.startswith("GET_") else f"`{to_igtl.igtl_type}`"
        assert any(wanted in line for line in lines), to_igtl


def test_every_definition_is_there() -> None:
    files = [path for folder in ("msg", "srv") for path in (docs.DEFINITIONS / folder).iterdir()]
    assert files
    assert [path.name for path in files if f"/{path.name})" not in conversions()] == []


def test_every_rule_is_there() -> None:
    numbers = [rule.id[6:] for rule in RULES]
    assert len(set(numbers)) == len(numbers) and {number[0] for number in numbers} == docs.GROUPS.keys()
    for rule in RULES:
        line = next(line for line in doctor().splitlines() if line.startswith(f"| `{rule.id}`"))
        assert rule.title in line and rule.advice in line


def test_every_check_of_the_machine_is_there() -> None:
    numbers = [check.id[6:] for check in HOST_CHECKS]
    assert len(set(numbers)) == len(numbers) and {number[0] for number in numbers} == {"9"}
    for check in HOST_CHECKS:
        line = next(line for line in doctor().splitlines() if line.startswith(f"| `{check.id}`"))
        assert check.title in line and check.advice in line and check.expected in line


def test_links_lead_somewhere(page: str) -> None:
    pages = {"": page, "messages.md": messages(), "conversions.md": conversions()}
    links = set(re.findall(r"\]\(([^)]+)\)", page))
    assert links or page == docs.notes()
    for link in links:
        if link.startswith("https://"):
            continue
        place, _, part = link.partition("#")
        if place not in pages:
            assert (docs.DOCS / "reference" / place).resolve().exists(), link
        elif part:
            assert part in anchors(pages[place]), link


def test_tables_are_whole(page: str) -> None:
    """As many cells in each row as in its head, or the rest of the row is not shown."""
    tables = re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)
    assert tables
    for table in tables:
        widths = {len(re.split(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(widths) == 1, table


def test_words_of_the_code_stay_there(page: str) -> None:
    """No reStructuredText, no names of Python's, no place on a disk."""
    assert re.findall(r"``|:class:|\bNone\b|ClassVar|<lambda>|/(?:work|home)/", page) == []


def test_lines_of_prose_are_no_longer_than_those_of_code(page: str) -> None:
    prose = [line for line in page.splitlines() if not line.startswith(("|", "- ", "<!--"))]
    assert [line for line in prose if len(line) > 120] == []


def test_a_layout() -> None:
    """Offsets as far as they are known, sizes in words where other fields give them, else the docstring."""
    rows = (
        Field("a", "u16", 3),
        Field("n", "u8", 1, "number of strings"),
        Field("size", "u32", 1, per="text"),
        Field("text", "char", "size", per="text"),
        Field("b", "f32", "2 · n"),
        Field("rest", "bytes", "the rest"),
    )
    assert docs.layout(rows, {"a": "first | last", "n": "unused"}).splitlines() == [
        "| offset | bytes | type | field | meaning |",
        "| ---: | --- | --- | --- | --- |",
        "| 0 | 6 | u16[3] | `a` | first \\| last |",
        "| 6 | 1 | u8 | `n` | number of strings |",
        "| … | 4 per text | u32 | `size` |  |",
        "| … | size per text | char[] | `text` |  |",
        "| … |  | f32[2 · n] | `b` |  |",
        "| … | the rest | bytes | `rest` |  |",
    ]


Constants = dict[str, str]


def constants_of(tree: ast.Module) -> Constants:
    """The strings that a module gives names to: ``A = "a"`` and ``A, B = "a", "b"``."""
    pairs: list[tuple[ast.expr, ast.expr]] = []
    for node in tree.body:
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                pairs += zip(names, values, strict=False)
            case ast.Assign(targets=[name], value=value):
                pairs.append((name, value))
    found: Constants = {}
    for pair in pairs:
        match pair:
            case (ast.Name(known), ast.Constant(str(text))):
                found[known] = text
    return found


def codes_in(tree: ast.Module, modules: dict[str, Constants] | None = None) -> set[str]:
    """The codes of notes in a module: behind a level, as an argument ``code``, of warnings, and of classes of errors.

    Args:
        tree: the module.
        modules: name of a module that it might import names from → its constants.
    """
    nodes = list(ast.walk(tree))
    known = constants_of(tree)
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module in (modules or {}):
            names = {each.name for each in node.names}
            known |= {name: text for name, text in (modules or {})[node.module or ""].items() if name in names}
    places = _places_of_codes(nodes)
    codes: list[ast.expr] = []
    for node in nodes:
        if isinstance(node, ast.Call | ast.Tuple):
            row = node.args if isinstance(node, ast.Call) else node.elts
            codes += [code for level, code in pairwise(row) if _is_level(level)]
        match node:
            case ast.Assign(targets=[ast.Name("code")], value=ast.Constant() as constant):
                codes.append(constant)
            case ast.Call(func=ast.Name(called) | ast.Attribute(attr=called), args=given) if called in places:
                codes += given[places[called] :][:1]
            case ast.Call(func=ast.Attribute(ast.Attribute(attr="warnings"), "append"), args=given):
                codes += [each.elts[0] for each in given if isinstance(each, ast.Tuple)]
            case ast.AugAssign(target=ast.Attribute(attr="warnings"), value=added):
                codes += [each.elts[0] for each in ast.walk(added) if isinstance(each, ast.Tuple)]
    found: set[object] = set()
    for part in (part for code in codes for part in ast.walk(code)):
        if isinstance(part, ast.Constant):
            found.add(part.value)
        elif isinstance(part, ast.Name):
            found.add(known.get(part.id))
    return {code for code in found if isinstance(code, str) and re.fullmatch(r"[a-z_0-9]+", code)}


def _is_level(node: ast.expr) -> bool:
    """Whether an expression is ``Level.…``, alone or with a condition."""
    match node:
        case ast.IfExp(body=ast.Attribute(ast.Name("Level"))) | ast.Attribute(ast.Name("Level")):
            return True
    return False


def _places_of_codes(nodes: list[ast.AST]) -> dict[str, int]:
    """Function or class with arguments ``code`` and ``text`` → where a call has the code."""
    owners = {
        id(method): node.name
        for node in nodes
        if isinstance(node, ast.ClassDef)
        for method in node.body
        if isinstance(method, ast.FunctionDef) and method.name == "__init__"
    }
    places = {}
    for node in nodes:
        if isinstance(node, ast.FunctionDef):
            names = [each.arg for each in node.args.args]
            if {"code", "text"} <= set(names):
                places[owners.get(id(node), node.name)] = names.index("code") - (names[0] == "self")
    return places


def test_every_code_of_a_note_is_there() -> None:
    root = docs.ROOT / "igtl_gateway"
    sources = {path.relative_to(root): path.read_text("utf-8") for path in root.rglob("*.py")}
    trees = {path: ast.parse(source) for path, source in sources.items()}
    modules = {
        ".".join(("igtl_gateway", *path.with_suffix("").parts)): constants_of(tree) for path, tree in trees.items()
    }
    written = {
        code
        for path, tree in trees.items()
        if path.parts[0] != "doctor" and path.parts[:2] != ("addons", "review")  # their levels are not those of notes
        for code in codes_in(tree, modules)
    }
    listed = [code for codes in NOTES.values() for code in codes]
    assert written and written - set(listed) == set()
    assert len(set(listed)) == len(listed)
    assert sorted(listed) == NOTE_CODES, "the codes that a trigger may name"
    everything = "".join(sources.values())
    assert [code for code in listed if f'"{code}"' not in everything] == []


def test_codes_are_found_wherever_they_are_written() -> None:
    source = """
from other import F, H
G, K = "g", "k"
Note(Level.WARN, "a", text)
(Level.INFO, "b" if x else "c")
class E:
    code = "d"
Note(level, "no")
Note(Level.INFO, F, text)
Note(Level.INFO, G, text)
def warn(entry, code, text): ...
warn(entry, "h", text)
class Refused(Exception):
    def __init__(self, code, text): ...
raise Refused("i", "text")
to.warnings.append(("j", text))
sent.warnings += [("l", warning)] if warning else []
"""
    assert codes_in(ast.parse(source), {"other": {"F": "f", "H": "no"}}) == set("abcdfghijl")


#: Where the names of a page begin: the gateway, its laboratory, the repository.
HOMES = (ROOT / "igtl_gateway", ROOT / "lab/igtl_gateway_lab", ROOT / "lab/igtl_gateway_lab/simulate", ROOT)


def is_there(name: str) -> bool:
    return any((home / name).is_dir() or (home / f"{name}.py").is_file() or (home / name).is_file() for home in HOMES)


def test_every_module_of_the_glossary_exists() -> None:
    lines = (ROOT / "docs/reference/glossary.md").read_text("utf-8").splitlines()
    rows = [line for line in lines if line.startswith("|")]
    found = set()
    places: tuple[str, ...] = ()
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        if cells[-1] in ("where", "meaning"):
            places = (cells[-1],)
        elif places == ("where",):
            found |= set(re.findall(r"`([\w/]+)`", cells[-1]))
    assert len(found) > 40
    assert [name for name in sorted(found) if not is_there(name)] == []


def test_every_file_of_the_architecture_exists() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text("utf-8")
    names = re.findall(r"`((?:addons|api|app|base|convert|gateway|edges|tests|tools|wire|lab|native)/[\w/.]+)`", text)
    names = [name for name in names if "NAME" not in name]
    assert len(names) > 40
    outside = [name for name in sorted(set(names)) if not is_there(name) and not is_there(name.partition(".")[0])]
    assert outside == []
