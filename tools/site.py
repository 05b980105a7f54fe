"""The documentation site: stage the pages, then build them.

    .venv/bin/python tools/site.py          build out/site/html (open index.html; no server is needed)
    .venv/bin/python tools/site.py --stage  write the pages in out/site/docs only

Strategy: the documents in docs/ are written for a reader of the repository, so their links also lead to source files.
A site needs each target as a page.  ``stage`` copies the documents, adds every file of the repository that a document
links to, converts the notebooks, and rewrites the links.  The builder (Zensical, by mkdocs.yml) then sees only plain
Markdown, and MkDocs with its theme Material can build the same folder.  Links that lead nowhere end the build.

The search of the theme ranks by titles.  So ``index_words`` adds the words of users as titles
(``site_words.toml``), and leaves out the pages that the navigation does not have.
"""

from __future__ import annotations

import base64
import json
import os
import posixpath
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from igtl_gateway.base.versions import tomllib

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "site"
#: Documents outside of docs/ that the navigation has.
PROJECT = (
    "README.md",
    "ARCHITECTURE.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "SECURITY.md",
    "CODE_OF_CONDUCT.md",
    "fixtures/README.md",
    "lab/README.md",
)
#: The words by which users look for pages.
WORDS = ROOT / "tools" / "site_words.toml"
#: Suffix → language of the code block; other files are plain text.
LANGUAGES = {".py": "python", ".toml": "toml", ".xml": "xml", ".yaml": "yaml", ".yml": "yaml", ".cfg": "ini"}

#: The page of the Python API, which is written only for the site.
API = "python-api.md"
API_INTRODUCTION = (
    "The names of `import igtl_gateway`, and what its functions return. [Python](how-to/python.md) is "
    "the introduction to them."
)
#: Its groups, with the place of each name below ``igtl_gateway``.
REFERENCE = {
    "Recordings": (
        "api.recording.open",
        "api.recording.Recording",
        "api.stream.Stream",
        "api.poses.Poses",
        "api.images.ImageView",
        "api.clouds.Cloud",
        "api.transforms.TransformTree",
        "api.alignment.align",
        "api.alignment.Aligned",
        "api.alignment.Match",
        "api.stream.RecordedMessage",
        "api.recording.RecordedNote",
    ),
    "Peers": (
        "api.peer.connect",
        "api.peer.serve",
        "api.peer.Peer",
        "api.peer.Server",
        "api.received.ReceivedMessage",
        "api.conversation.CommandReply",
        "api.conversation.PeerCounts",
    ),
    "Peers with asyncio": (
        "api.aio.connect",
        "api.aio.serve",
        "api.aio.AsyncPeer",
        "api.aio.AsyncServer",
    ),
    "Bridge": (
        "api.bridge.Bridge",
        "api.bridge.BridgeCounts",
        "api.bridge.RecordingResult",
    ),
    "Verbs": (
        "api.verbs.replay_recording",
        "api.verbs.verify",
        "addons.review.api.review",
        "addons.resim.api.resim",
        "api.verbs.diff",
        "app.replaying.ReplayResult",
        "app.verification.Verification",
        "app.comparison.RecordingDiff",
        "addons.resim.api.Resimulation",
    ),
    "Lags": (
        "addons.sync.lags.lag",
        "addons.sync.lag.Lag",
    ),
}

_FENCE = re.compile(r"^( *)(`{3,}|~{3,})[^\n]*\n.*?^\1\2`* *$", re.DOTALL | re.MULTILINE)
_LINK = re.compile(r"(?P<code>(`+)(?!`).+?(?<!`)\2(?!`))|(?P<text>\[[\w./-]+\.md)?\]\((?P<target>[^)\s]+)\)", re.DOTALL)
_LIST = re.compile(r"^(?! *(?:[-*+]|\d+\.) |\s|$)(?P<before>[^\n]+)\n(?=(?:[-*+]|\d+\.) )", re.MULTILINE)


class SiteError(Exception):
    """A document that the site cannot have."""


def page_of(path: str) -> str:
    """The place in the site, below its documents, of a file of the repository (``path`` with "/", from its root)."""
    if path.startswith("docs/"):
        inside = path.removeprefix("docs/")
        return inside.removesuffix(".ipynb") + ".md" if inside.endswith(".ipynb") else inside
    if path.endswith(".md"):
        return "project/" + path.lower().replace("/", "-")
    return f"source/{path}.md"


def _outside_fences(text: str) -> Iterator[tuple[bool, str]]:
    """The text in pieces: whether it is prose, and the piece."""
    end = 0
    for match in _FENCE.finditer(text):
        yield True, text[end : match.start()]
        yield False, match[0]
        end = match.end()
    yield True, text[end:]


def rewrite(text: str, path: str, found: list[str], root: Path = ROOT) -> str:
    """The document at ``path`` as a page of the site; appends what it links to to ``found``.

    Raises SiteError for a link to a file that does not exist.
    """
    here = posixpath.dirname(page_of(path))

    def link(match: re.Match[str]) -> str:
        target = match["target"]
        if match["code"] or "://" in target or target.startswith(("#", "mailto:")):
            return match[0]
        place, mark, part = target.partition("#")
        wanted = posixpath.normpath(posixpath.join(posixpath.dirname(path), place))
        is_document = wanted.split("/")[0] == "docs"  # a folder of them has no page
        exists = (root / wanted).is_file() if is_document else (root / wanted).exists()
        if not exists or wanted.startswith(".."):
            raise SiteError(f"{path}: found a link to {target}, expected a file of the repository")
        found.append(wanted)
        text = match["text"] or ""
        if is_document and text.lstrip("[") == posixpath.basename(
            wanted
        ):  # the name of a file: on a site, the title of its page
            text = "[" + (root / wanted).read_text("utf-8").partition("\n")[0].lstrip("# ")
        return f"{text}]({posixpath.relpath(page_of(wanted), here)}{mark}{part})"

    def prose(piece: str) -> str:
        # GitHub starts a list without an empty line before it, Python's Markdown does not.
        return _LIST.sub(lambda match: f"{match['before']}\n\n", _LINK.sub(link, piece))

    return "".join(prose(piece) if is_prose else piece for is_prose, piece in _outside_fences(text))


def source_page(path: str, root: Path = ROOT) -> str:
    """A file or folder of the repository as a document."""
    file = root / path
    if file.is_dir():
        listed = subprocess.run(
            ["git", "ls-files", "--", path], cwd=root, check=True, capture_output=True, text=True
        ).stdout.split()
        lines = [f"- [{name}]({posixpath.relpath(name, posixpath.dirname(path))})" for name in listed]
        return "\n".join([f"# `{path}`", "", *lines, ""])
    text = file.read_text("utf-8")
    ticks = "`" * max([3, *(len(run) + 1 for run in re.findall(r"`+", text))])
    return f"# `{path}`\n\n{ticks}{LANGUAGES.get(file.suffix, 'text')}\n{text.rstrip()}\n{ticks}\n"


def notebook_page(path: str, pictures: dict[str, bytes], root: Path = ROOT) -> str:
    """A notebook as a document: its cells with the outputs that are stored in it; pictures go to ``pictures``."""
    cells: list[dict[str, Any]] = json.loads((root / path).read_text("utf-8"))["cells"]
    name = posixpath.basename(path)
    parts: list[str] = []
    for cell in cells:
        source = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{name.removesuffix('.ipynb')}-{len(pictures) + 1}.png"
                pictures[picture] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Output of the cell above]({picture})")
            elif text := "".join(output.get("text", data.get("text/plain", ""))).rstrip():
                parts.append(f"```text\n{text}\n```")
    parts.insert(1, f"[Download the notebook]({name}){{ download }}")
    return "\n\n".join(parts) + "\n"


def api_page() -> str:
    """The reference of the Python API, as directives for mkdocstrings."""
    parts = ["# Python API", API_INTRODUCTION]
    for group, places in REFERENCE.items():
        parts += [f"## {group}", *(f"::: igtl_gateway.{place}" for place in places)]
    return "\n\n".join(parts) + "\n"


def stage(folder: Path, root: Path = ROOT) -> list[str]:
    """Write all pages below ``folder``, and return their places in it.

    Raises SiteError for a link to a file that does not exist.
    """
    waiting = [*PROJECT, *(file.relative_to(root).as_posix() for file in sorted((root / "docs").rglob("*.*")))]
    done: dict[str, str] = {}
    while waiting:
        path = waiting.pop()
        if path in done:
            continue
        done[path] = page = page_of(path)
        place = folder / page
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.endswith(".ipynb"):
            pictures: dict[str, bytes] = {}
            place.write_text(notebook_page(path, pictures, root), "utf-8")
            shutil.copyfile(root / path, place.parent / posixpath.basename(path))
            for name, data in pictures.items():
                (place.parent / name).write_bytes(data)
        elif path.endswith(".md"):
            place.write_text(rewrite((root / path).read_text("utf-8"), path, waiting, root), "utf-8")
        elif page.startswith("source/"):
            place.write_text(rewrite(source_page(path, root), path, waiting, root), "utf-8")
        else:
            shutil.copyfile(root / path, place)
    (folder / API).write_text(api_page(), "utf-8")
    return sorted([*done.values(), API])


def navigation(configuration: str) -> set[str]:
    """The pages of the navigation of ``mkdocs.yml``."""
    return set(re.findall(r"\S+\.md$", configuration.partition("\nnav:\n")[2], re.MULTILINE))


def index_words(index: dict[str, Any], words: dict[str, list[str]], shown: set[str]) -> dict[str, Any]:
    """The index of the search with the words of users in front, for the pages that are shown.

    The search puts what stands in a title first, then the shorter distance and the earlier place, then the earlier
    entry.  An entry for a heading needs the heading.  The properties of the API have their class before them.

    Args:
        index: ``search.json`` of the site.
        words: page, perhaps with a heading → words of users.
        shown: pages of the navigation.

    Raises SiteError for words of a page or a heading that does not exist.
    """
    items = [item for item in index["items"] if _page_of_item(item) in shown]
    for item in items:
        place = item["location"].partition("#igtl_gateway.")[2].split(".")
        if len(place) > 1 and place[-2][:1].isupper():
            item["title"] = f"{place[-2]}.{item['title']}"
    found = {item["location"]: item for item in reversed(items)}
    entries = []
    for place, titles in words.items():
        location = place.replace(".md", ".html", 1)
        if location not in found:
            raise SiteError(f"tools/site_words.toml: found {place}, expected a page or a heading of the site")
        entries += [{**found[location], "title": title, "text": ""} for title in titles]
    return {**index, "items": [*entries, *items]}


def _page_of_item(item: dict[str, Any]) -> str:
    return str(item["location"]).partition("#")[0].replace(".html", ".md")


def build(out: Path = OUT) -> Path:
    """Stage and build; the folder of the HTML.  Raises SiteError with the output of the builder."""
    shutil.rmtree(out, ignore_errors=True)
    stage(out / "docs")
    shutil.copyfile(ROOT / "mkdocs.yml", out / "mkdocs.yml")
    shutil.copytree(ROOT / "tools" / "site_theme", out / "theme")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    built = subprocess.run(
        [sys.executable, "-m", "zensical", "build", "--strict", "--clean"],
        cwd=out,
        env=environment,
        check=False,
        capture_output=True,
        text=True,
    )
    if built.returncode:
        raise SiteError(built.stdout + built.stderr)
    html = out / "html"
    index = index_words(
        json.loads((html / "search.json").read_text("utf-8")),
        tomllib.loads(WORDS.read_text("utf-8")),
        navigation((ROOT / "mkdocs.yml").read_text("utf-8")),
    )
    text = json.dumps(index, ensure_ascii=False, separators=(",", ":"))
    (html / "search.json").write_text(text, "utf-8")
    (html / "search.js").write_text(f"var __index = {text}", "utf-8")  # of pages that are opened as files
    return html


def main(arguments: Sequence[str]) -> int:
    try:
        if list(arguments) == ["--stage"]:
            shutil.rmtree(OUT, ignore_errors=True)
            stage(OUT / "docs")
        else:
            print(build() / "index.html")
    except SiteError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
