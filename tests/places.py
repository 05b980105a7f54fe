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
#: Keys and certificates of the tests with TLS.
PEMS = ROOT / "tests" / "edges" / "tcp" / "pems"
