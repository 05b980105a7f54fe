"""``tools/site.py``: the site builds offline and strictly, every page is reachable, and every link leads somewhere."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from ruamel.yaml import YAML

import igtl_gateway
from igtl_gateway.base.versions import tomllib
from tools import site

CONFIGURATION = (site.ROOT / "mkdocs.yml").read_text("utf-8")


@dataclass
class Page:
    """What a page offers to links, and what it links to or loads."""

    anchors: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)


class Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.page = Page()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.page.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.page.links.append(values["href"])
        elif tag in ("img", "script", "source", "iframe") and "src" in values:
            self.page.loaded.append(values["src"])
        elif tag == "link" and values.get("rel") not in ("canonical", "prev", "next"):
            self.page.loaded.append(values.get("href", ""))


def read(path: Path) -> Page:
    reader = Reader()
    reader.feed(path.read_text("utf-8"))
    return reader.page


def broken(html: Path) -> list[str]:
    """The links of all pages below ``html`` that lead nowhere, and what they load from elsewhere."""
    pages = {path: read(path) for path in html.rglob("*.html") if path.name != "404.html"}
    found = []
    for path, page in pages.items():
        for link in page.links + page.loaded:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                if link in page.loaded and parts.scheme != "data":
                    found.append(f"{path.relative_to(html)} loads {link}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                found.append(f"{path.relative_to(html)}: {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{path.relative_to(html)}: {link}")
    return found


@pytest.fixture(scope="module")
def html(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("zensical", reason="zensical is not installed here")
    return site.build(tmp_path_factory.mktemp("site"))


def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere(html: Path) -> None:
    assert len(list(html.rglob("*.html"))) > 40
    assert broken(html) == []


def test_no_markup_is_left_in_the_text(html: Path) -> None:
    """Python's Markdown is stricter than GitHub's: what it does not understand would be shown as written."""
    shown = [
        (path.name, match)
        for path in html.rglob("*.html")
        if path.parent.name != "source"
        for match in re.findall(
            r"<p>(?:[-*] |\||```|#+ )[^<]{0,40}|\]\([\w./#-]+\)",
            re.sub(r"<(pre|code)\b.*?</\1>", "", path.read_text("utf-8"), flags=re.DOTALL),
        )
    ]
    assert shown == []


def test_the_check_of_links_finds_a_missing_page_anchor_and_a_foreign_script(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<a href="b.html#here"></a><a href="b.html#gone"></a><a href="c.html"></a><script src="https://x/y.js"></script>'
    )
    (tmp_path / "b.html").write_text('<p id="here">')
    assert broken(tmp_path) == ["a.html: b.html#gone", "a.html: c.html", "a.html loads https://x/y.js"]


def test_every_page_has_a_place_in_the_navigation_or_is_for_readers_of_the_repository(tmp_path: Path) -> None:
    staged = [page for page in site.stage(tmp_path) if page.endswith(".md")]
    left_out = re.findall(r"^  (\S+)$", CONFIGURATION.partition("\nnot_in_nav: |\n")[2], re.MULTILINE)
    listed = re.findall(r"\S+\.md$", CONFIGURATION.partition("\nnav:\n")[2], re.MULTILINE)
    shown = [page for page in staged if not any(fnmatch(page, pattern) for pattern in left_out)]
    assert sorted(listed) == sorted(shown)  # each once
    assert all(any(fnmatch(page, pattern) for page in staged) for pattern in left_out)
    assert not [page for page in listed if page.startswith(("evidence/", "adr/"))]


def test_every_public_name_is_in_the_reference() -> None:
    listed = {place.rpartition(".")[2] for places in site.REFERENCE.values() for place in places}
    assert set(igtl_gateway.__all__) - {"__version__", "aio"} <= listed


def test_links_lead_to_the_pages_of_the_site(tmp_path: Path) -> None:
    for name in ("docs/adr/README.md", "docs/a.md", "src/x.msg", "README.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("`" if name == "src/x.msg" else "# Title\n")
    found: list[str] = []
    assert site.rewrite("[a.md](a.md#b), [b.md](a.md)", "docs/c.md", found, tmp_path) == "[Title](a.md#b), [b.md](a.md)"
    found.clear()
    text = "[a](../a.md#b) [m](../../src/x.msg)\n- [r](../../README.md)\n\n```\n[no](gone.md)\n```\n`[no](gone.md)`\n"
    assert site.rewrite(text, "docs/adr/README.md", found, tmp_path) == (
        "[a](../a.md#b) [m](../source/src/x.msg.md)\n\n- [r](../project/readme.md)\n\n"
        "```\n[no](gone.md)\n```\n`[no](gone.md)`\n"
    )
    assert found == ["docs/a.md", "src/x.msg", "README.md"]
    with pytest.raises(
        site.SiteError, match=r"^docs/a.md: found a link to gone.md, expected a file of the repository$"
    ):
        site.rewrite("[x](gone.md)", "docs/a.md", [], tmp_path)
    assert site.source_page("src/x.msg", tmp_path) == "# `src/x.msg`\n\n```text\n`\n```\n"


def levels(entries: list[Any]) -> Iterator[int]:
    """The numbers of entries of each level of a navigation; a page without a title that leads its level is its head."""
    yield sum(not (position == 0 and isinstance(entry, str)) for position, entry in enumerate(entries))
    for entry in entries:
        for below in entry.values() if isinstance(entry, dict) else ():
            if isinstance(below, list):
                yield from levels(below)


def test_no_level_of_the_navigation_has_more_than_eight_entries() -> None:
    text = "nav:\n" + CONFIGURATION.partition("\nnav:\n")[2]
    assert max(levels(YAML(typ="safe", pure=True).load(text)["nav"])) <= 8


#: What users type → the page that they look for.
QUERIES = {
    "nrrd": "how-to/slicer",
    "import nifti": "reference/formats",
    "latency between streams": "how-to/sync",
    "delay of the camera": "how-to/sync",
    "frame": "how-to/ros-robot",
    "coordinate system": "how-to/python",
    "disk full": "how-to/keeping",
    "delete old": "how-to/keeping",
    "upload s3": "how-to/keeping",
    "share a recording with a colleague": "how-to/deidentify",
    "anonymize": "how-to/deidentify",
    "patient name": "how-to/deidentify",
    "docker": "how-to/deploy",
    "jetson": "how-to/deploy",
    "systemd": "how-to/deploy",
    "plot": "how-to/view",
    "urdf": "how-to/view",
    "web page": "how-to/page",
    "tablet": "how-to/page",
    "rosbag": "reference/formats",
    "csv": "reference/formats",
    "wireshark": "reference/formats",
    "numpy": "how-to/python",
    "pandas": "how-to/python",
    "unit test": "how-to/offline-test",
    "without hardware": "how-to/testing",
    "packet loss": "how-to/faults",
    "ultrasound": "how-to/plus",
    "polaris": "how-to/plus",
    "slicer": "how-to/slicer",
    "nothing arrives": "how-to/nothing-arrives",
    "topic empty": "how-to/nothing-arrives",
    "igs.mha": "how-to/plus-to-slicer",
    "connection refused": "how-to/slicer",
    "robot arm": "how-to/ros-robot",
    "da vinci": "how-to/dvrk",
    "lifecycle": "how-to/lifecycle",
    "prometheus": "how-to/metrics",
    "firewall": "how-to/security",
    "certificate": "how-to/security",
    "stale": "how-to/guard",
    "lost messages": "how-to/guard",
    "clock drift": "how-to/guard",
    "bookmark": "how-to/marks",
    "combine recordings": "how-to/merge",
    "training data": "how-to/lerobot",
    "launch file": "how-to/ros-package",
    "regression test": "how-to/resim",
    "tamper": "how-to/seal",
    "repair": "reference/command-line",
    "quick start": "start/tutorial",
    "uninstall": "start/install",
    "foxglove": "start/coming-from",
    "millimetres": "reference/conversions",
    "file size": "how-to/disk",
    "frame not found": "how-to/nothing-arrives",
    "high latency": "reference/doctor",
    "trim": "reference/command-line",
    "cut a recording": "reference/command-line",
    "matlab": "reference/formats",
    "excel": "reference/formats",
    "duckdb": "reference/formats",
    "realsense": "how-to/ros-robot",
    "multiple robots": "how-to/ros-robot",
    "two slicers": "how-to/slicer",
    "hololens": "start/coming-from",
}


@pytest.fixture(scope="module")
def search(html: Path) -> Callable[[Sequence[str]], list[list[str]]]:
    """Function: the pages that the search of the site finds for each query, in its order."""
    if not shutil.which("node"):
        pytest.skip("no node here, which runs the search as a browser does")

    def pages(queries: Sequence[str]) -> list[list[str]]:
        run = ["node", str(Path(__file__).with_name("site_search.js")), str(html)]
        done = subprocess.run(run, input="\n".join(queries), capture_output=True, text=True, check=True, timeout=120)
        places = [json.loads(line) for line in done.stdout.splitlines()]
        return [list(dict.fromkeys(place.partition(".html")[0] for place in found)) for found in places]

    return pages


def test_the_words_of_users_find_their_page_among_the_first_three(
    search: Callable[[Sequence[str]], list[list[str]]],
) -> None:
    assert len(QUERIES) >= 40
    found = dict(zip(QUERIES, search(list(QUERIES)), strict=True))
    assert {query: found[query][:3] for query, page in QUERIES.items() if page not in found[query][:3]} == {}
    first = sum(found[query][0] == page for query, page in QUERIES.items())
    assert first >= 0.8 * len(QUERIES)


def test_the_search_has_what_the_navigation_has(html: Path) -> None:
    shown = site.navigation(CONFIGURATION)
    items = json.loads((html / "search.json").read_text("utf-8"))["items"]
    assert {item["location"].partition("#")[0].replace(".html", ".md") for item in items} == shown


def test_words_are_of_a_page_that_exists() -> None:
    item = {"location": "how-to/a.html", "title": "A", "text": "t", "path": ["How-to", "A"], "level": 1}
    other = {**item, "location": "adr/b.html"}
    index = site.index_words({"items": [item, other]}, {"how-to/a.md": ["B, c"]}, {"how-to/a.md"})
    assert index["items"] == [{**item, "title": "B, c", "text": ""}, item]
    with pytest.raises(site.SiteError, match=r"found how-to/b.md#c, expected a page or a heading of the site"):
        site.index_words({"items": [item]}, {"how-to/b.md#c": ["B"]}, {"how-to/a.md"})


def test_each_page_of_words_is_in_the_navigation_and_no_words_come_twice() -> None:
    words = tomllib.loads(site.WORDS.read_text("utf-8"))
    assert {place.partition("#")[0] for place in words} <= site.navigation(CONFIGURATION)
    titles = [title for each in words.values() for title in each]
    assert len(titles) == len(set(titles))


#: Types a word into the search, letter by letter, and leaves what the field and the results then have in the title.
TYPING = """
<script>
addEventListener("load", async () => {
  const wait = async (found) => {
    for (;;) {
      const roots = [document, ...[...document.querySelectorAll("*")].map((each) => each.shadowRoot).filter(Boolean)];
      const each = roots.map(found).find(Boolean);
      if (each) return each;
      await new Promise((done) => setTimeout(done, 50));
    }
  };
  const button = await wait((root) => root.querySelector(".md-search__button"));
  button.click();
  const field = await wait((root) => root.querySelector("input[role=combobox]"));
  for (const letter of "verify") {
    field.value += letter;
    field.dispatchEvent(new Event("input", { bubbles: true }));
    await new Promise((done) => setTimeout(done, 200));
  }
  await wait((root) => root.querySelector("a[href*='command-line.html'][href$='#verify']"));
  document.title = `found ${field.value}`;
});
</script>
"""


@pytest.mark.skipif(not shutil.which("chromium"), reason="no chromium here")
def test_the_search_finds_what_is_typed_in_a_page_that_is_opened_as_a_file(html: Path, tmp_path: Path) -> None:
    page = html / "index.html"
    text = page.read_text("utf-8")
    typing = page.with_name("typing.html")
    typing.write_text(text.replace("</body>", f"{TYPING}</body>"), "utf-8")
    run = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}"]
    try:
        shown = subprocess.run(
            [*run, "--virtual-time-budget=20000", "--timeout=60000", "--dump-dom", typing.as_uri()],
            capture_output=True, text=True, check=True, timeout=120,
        ).stdout  # fmt: skip
    finally:
        typing.unlink()
    assert "<title>found verify</title>" in shown
