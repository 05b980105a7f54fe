"""``igtl-gateway seal``: seal a recording that exists already."""

from __future__ import annotations

import argparse

from igtl_gateway.app.sealing import seal_recording, stamp_recording
from igtl_gateway.base.quantities import size_text
from igtl_gateway.cli.terminal import print_line


def run(options: argparse.Namespace) -> int:
    if options.time_stamp:
        digest, size = stamp_recording(options.file, options.time_stamp, options.output, overwrite=options.overwrite)
        print_line(f"{options.output}: {size_text(size)}, with the time stamp of the seal {digest}")
        return 0
    key, size = seal_recording(options.file, options.key, options.output, overwrite=options.overwrite)
    print_line(f"{options.output}: {size_text(size)}, sealed by key {key}")
    return 0
