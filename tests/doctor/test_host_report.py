"""The report of a machine, as lines, as JSON, and on the command line."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.errors import Unavailable
from igtl_gateway.cli import main
from igtl_gateway.doctor.host_checks import HOST_CHECKS
from igtl_gateway.doctor.host_report import HostReport, examine_host
from tests.doctor.test_host_checks import GOOD, MEASURED


def test_lines_have_findings_first_then_the_rest() -> None:
    facts = replace(GOOD, governors=("powersave",), autogroup=True, smt=None)
    lines = list(HostReport.of(facts, MEASURED).lines())
    assert lines[:6] == [
        "WARNING IGTL-W903  CPU frequency",
        "        - found governor powersave, expected governor performance",
        "        `cpupower frequency-set --governor performance`",
        "INFO    IGTL-I911  scheduling by session (autogroup)",
        "        - found autogroup is on, expected off",
        "        `sysctl kernel.sched_autogroup_enabled=0`; with it, a nice value counts only within its session",
    ]
    assert "ok      IGTL-W921  clock source: tsc" in lines
    assert lines[-2:] == [
        "unknown IGTL-I906  SMT (hyper-threading): not shown by this system",
        "1 warning: CPU frequency (IGTL-W903)",
    ]
    assert len(lines) == 6 + len(HOST_CHECKS) - 2 + 1


def test_the_last_line() -> None:
    assert list(HostReport.of(GOOD, MEASURED).lines())[-1] == "no problems found"
    facts = replace(GOOD, load=9.0, swap_bytes=1 << 30, huge_pages="always", synchronised=False)
    last = list(HostReport.of(facts, MEASURED).lines())[-1]
    assert last == "4 warnings: load (IGTL-W907), swap (IGTL-W916), transparent huge pages (IGTL-W915), …"


def test_json() -> None:
    found = json.loads(json.dumps(HostReport.of(replace(GOOD, load=9.0), MEASURED).to_dict()))
    (load,) = [check for check in found["checks"] if check["status"] == "finding"]
    assert load == {
        "id": "IGTL-W907",
        "severity": "warning",
        "title": "load",
        "status": "finding",
        "found": "load 9 on 8 CPUs",
        "expected": "up to 0.7 for each CPU",
        "advice": "stop other programs, or move them to another machine",
        "section": "docs/reference/doctor.md: The machine",
    }
    assert found["measured"] == {
        "lateness": {"p50_ns": 60_000, "p99_ns": 120_000, "max_ns": 900_000},
        "handover": {"p50_ns": 4_000, "p99_ns": 12_000, "max_ns": 80_000},
        "steal": 0.001,
    }


@pytest.mark.skipif(sys.platform != "linux", reason="Linux only")
def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--host", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [check["id"] for check in found["checks"]] == [check.id for check in HOST_CHECKS]
    assert found["measured"]["lateness"]["max_ns"] > 0


def test_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--host", ":18944"]) == 2
    assert "--host: found a peer or a recording, expected --host alone" in capsys.readouterr().err


def test_other_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(Unavailable, match="--host: found darwin, expected Linux"):
        examine_host(SystemClock())
