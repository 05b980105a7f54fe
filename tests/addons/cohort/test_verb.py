"""``igtl-gateway cohort``: wrong usage, and exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.cli import main
from tests.tables import table


@table(
    ("arguments", "message"),
    [
        (["info"], "found no source"),
        (["info", "nothing-*.mcap"], "found no session"),
        (["query"], "expected one: the SQL"),
        (["info", "x.mcap", "--html", "x"], "--html: found it with info"),
        (["report", "x.mcap"], "expected no source"),
        (["info", "x.mcap", "--workers", "0"], "--workers: found 0"),
        (["info", "x.mcap", "--timeout", "nan"], "--timeout: found nan"),
        (["info", "x.mcap", "--tls-ca", "ca.pem"], "expected all three"),
    ],
)
def test_wrong_usage(tmp_path: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cohort", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_things_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')
    (tmp_path / "thesis.tex").touch()
    assert main(["cohort", "info", str(tmp_path), "-o", str(tmp_path)]) == 2
    assert "expected tables of a cohort or a new folder" in capsys.readouterr().err


def test_why_a_file_gave_no_rows_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason='needs pyarrow: pip install "igtl-gateway[cohort]"')
    absent = tmp_path / "absent.mcap"
    assert main(["cohort", "info", "-o", str(tmp_path / "out"), str(absent)]) == 1
    assert f"1 unsupported: {absent}: No such file or directory\n" in capsys.readouterr().out
