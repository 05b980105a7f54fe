"""The modules that the glossary and the map of the architecture name are there."""

from __future__ import annotations

import re

from tests.places import ROOT

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
