"""What ``doctor`` prints of a connection or a recording."""

from __future__ import annotations

from igtl_gateway.cli.terminal import aligned, print_line
from igtl_gateway.doctor.report import DoctorReport


def print_doctor(report: DoctorReport) -> None:
    """Print the peers, the streams as a table, and the findings."""
    for line in report.peer_lines():
        print_line(line)
    if rows := report.stream_rows():
        print_line(*aligned(rows, text=True))
    for line in report.finding_lines():
        print_line(line)
