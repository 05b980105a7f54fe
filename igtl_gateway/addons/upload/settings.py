"""The settings that a bridge has with this add-on.  Loaded at each start of a bridge: nothing here reaches a store."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.addon.settings import RECORD, Setting, grouped
from igtl_gateway.addons.upload.place import upload_place

SETTINGS = grouped(
    "recording",
    Setting(
        "upload",
        "",
        "copy closed recordings and parts to this object store (S3) in the background; keys come from the environment "
        "or from ~/.aws",
        RECORD,
        metavar="s3://BUCKET[/PREFIX]",
        reads=upload_place,
        needs=("record",),
    ),
    Setting(
        "upload_rate",
        0.0,
        "with --upload: maximum rate; 0: no limit",
        RECORD,
        metavar="MB/S",
        unit="MB/s",
        least=0,
        most=100_000,
        shown="0",
        needs=("upload",),
    ),
)

#: Options of ``keep``.
_PLACE, _RATE = SETTINGS
KEEPING = (
    replace(_PLACE, about="where to: a bucket, and what the keys in it begin with", needs=(), old=("--to",)),
    replace(_RATE, about="maximum rate; 0: no limit", old=("--rate",)),
    Setting(
        "patience",
        60.0,
        "give up when no file was confirmed for this time and the store has a problem",
        metavar="SECONDS",
        unit="s",
        least=0,
        needs=("upload",),
    ),
)
