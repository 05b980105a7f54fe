"""The report of a salvage: whole or not, and bounded."""

from __future__ import annotations

import pytest

from igtl_gateway.record.sessionfile import salvage_report
from igtl_gateway.record.sessionfile.salvage_report import Loss, SalvageReport


def test_a_file_without_an_end_is_not_whole() -> None:
    assert not SalvageReport(10).whole
    assert SalvageReport(10, closed=True).whole


def test_further_losses_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(salvage_report, "MAX_LOSSES", 2)
    report = SalvageReport(10, closed=True)
    for at in range(5):
        report.add(Loss(salvage_report.CHUNK, at, 1, 0, 0, "its checksum is wrong"))
    assert ([loss.at for loss in report.lost], report.more_lost, report.whole) == ([0, 1], 3, False)
