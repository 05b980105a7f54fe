"""``igtl-gateway doctor FILE``, formerly ``lint``: the rules of ``doctor`` on a recording."""

from __future__ import annotations

import argparse

from igtl_gateway.app.linting import observe
from igtl_gateway.base.addons import is_present, part_of
from igtl_gateway.base.errors import BeingRecorded, DamagedRecording
from igtl_gateway.base.quantities import count_text
from igtl_gateway.cli.doctor_output import print_doctor
from igtl_gateway.cli.terminal import print_json, print_line
from igtl_gateway.doctor.report import DoctorReport
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from igtl_gateway.replay.source import without_messages


def run(options: argparse.Namespace) -> int:
    try:
        with SessionFile.open(options.file) as file:
            if not file.entry_count and any(each.count for each in file.skipped):
                raise without_messages(file)
            seen = observe(file, options.config)
        if is_present("sync"):
            seen.lags = part_of("sync", "pointing:late_streams")(options.file)
    except DamagedRecording as error:
        if options.file.is_dir():
            raise  # it names the part that is damaged
        with Salvage.open(options.file) as salvage:
            seen = observe(salvage, options.config)
        if isinstance(error, BeingRecorded):
            seen.growing = str(error).removeprefix(f"{options.file}: ")
        else:
            seen.damage = str(error)
    report = DoctorReport.of(seen)
    if options.json:
        print_json({"file": str(options.file)} | report.to_dict())
    else:
        print_line(f"{options.file}: {count_text(len(seen.streams), 'OpenIGTLink stream')}")
        print_doctor(report)
    return int(report.failed)
