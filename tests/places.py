"""Where the tests find the project and its recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

import igtl_gateway

#: The project's folder.
ROOT = Path(__file__).resolve().parents[1]
#: The package that is tested: that of the project's folder, or an installed one.
PACKAGE = Path(igtl_gateway.__file__).resolve().parent
#: For tests that compare the package with files that are not installed.
needs_sources = pytest.mark.skipif(
    PACKAGE.parent != ROOT, reason="an installed igtl-gateway is tested, without its sources"
)
FIXTURES = ROOT / "fixtures"
#: Small recordings: together they have all types, both directions, commands, and losses.
LIGHT = ("acquisition", "crtk", "every-type", "paper-types")


def is_light(path: Path) -> bool:
    """Whether this is one of the small recordings: of checks of all, which take seconds, the gate has these."""
    return path.stem in LIGHT


#: Keys and certificates of the tests with TLS.
PEMS = ROOT / "tests" / "edges" / "tcp" / "pems"
