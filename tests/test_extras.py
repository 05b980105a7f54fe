"""The sentence for what is missing."""

from __future__ import annotations

from igtl_gateway.extras import missing


def test_a_broken_installation_is_told_from_none() -> None:
    assert missing("av") == 'av is not installed here: pip install "igtl-gateway[video]"'
    assert missing("av", ModuleNotFoundError("No module named 'av'", name="av")) == missing("av")
    broken = missing("av", ImportError("libx264.so.164: cannot open shared object file\nmore"))
    assert broken.startswith("av cannot be imported (libx264.so.164: cannot open shared object file): pip install")
