"""The options of ``igtl-gateway review``."""

from __future__ import annotations

from igtl_gateway.addon.settings import Setting
from igtl_gateway.addon.terminal import file_name
from igtl_gateway.addons.review.choices import ReviewSelection, Thresholds, rows_of

OPTIONS = (
    *rows_of(ReviewSelection),
    Setting(
        "output",
        "",
        "write a table with one row per stitch and version",
        metavar="OUT",
        reads=file_name(".csv"),
        short="-o",
        old=("--csv",),
    ),
    Setting("overwrite", False, "overwrite an existing table", needs=("output",)),
    Setting("json", False, "print the result as one JSON object"),
    *rows_of(Thresholds, "thresholds"),
)
