"""Where the tests find the project and its recordings."""

from __future__ import annotations

from pathlib import Path

#: The project's folder.
ROOT = Path(__file__).resolve().parents[1]
FIXTURES = ROOT / "fixtures"
#: Keys and certificates of the tests with TLS.
PEMS = ROOT / "tests" / "edges" / "tcp" / "pems"
