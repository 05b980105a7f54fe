"""``igtl-gateway upload``: the upload of ``bridge --upload``, once."""

from __future__ import annotations

import argparse
from pathlib import Path

from igtl_gateway.addon import (
    NS_PER_S,
    ConfigError,
    Note,
    RecordingError,
    SystemClock,
    add_json,
    count_text,
    default,
    parser_of,
    print_json,
    print_line,
    size_text,
    stop_event,
)
from igtl_gateway.addons.upload.place import upload_place
from igtl_gateway.addons.upload.uploading import CONFIRMED, Uploader

EXAMPLES = """\
  # upload all recordings of a directory, or what a bridge has left of them
  igtl-gateway upload recordings --to s3://sessions/or1
  # with 2 MB/s at most, and give up when the store is away for 10 minutes
  igtl-gateway upload recordings --to s3://sessions/or1 --rate 2 --patience 600

Keys come from AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or from ~/.aws;
AWS_ENDPOINT_URL names another store than that of AWS. An upload that was
interrupted continues. Objects are created, never replaced."""

_LOOK_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", type=Path, help="directory of recordings")
    parser.add_argument(
        "--to",
        required=True,
        metavar="s3://BUCKET[/PREFIX]",
        type=parser_of(upload_place),
        help="where to: a bucket, and what the keys in it begin with",
    )
    parser.add_argument("--rate", type=float, default=0.0, metavar="MB/S", help="maximum rate " + default("no limit"))
    parser.add_argument(
        "--patience",
        type=float,
        default=60.0,
        metavar="SECONDS",
        help="give up when no file was confirmed for this time and the store has a problem " + default(60),
    )
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    if not options.folder.is_dir():
        raise RecordingError(f"{options.folder}: found no directory, expected one with recordings")
    for name in ("rate", "patience"):
        if not 0 <= getattr(options, name) < float("inf"):
            raise ConfigError(f"--{name}: found {getattr(options, name):g}, expected 0 or more")
    clock = SystemClock()
    with stop_event() as stop:

        def show(note: Note) -> None:
            if not options.json:
                print_line(note.text, error=note.code != CONFIRMED, flush=True)

        folder = options.folder.absolute()
        uploader = Uploader(folder, None, options.to, options.rate * 1e6, clock, show, stop.is_set)
        counts = uploader.counts
        good_ns, confirmed = clock.monotonic_ns(), 0
        try:
            while not uploader.step() and not stop.wait(_LOOK_S):
                if counts.confirmed != confirmed or not counts.problem:
                    good_ns, confirmed = clock.monotonic_ns(), counts.confirmed
                    if not counts.problem:
                        break  # what still waits cannot be uploaded: notes state why
                if clock.monotonic_ns() - good_ns > options.patience * NS_PER_S:
                    break
            left = uploader.waiting()
        finally:
            uploader.close()
    if options.json:
        print_json(
            {
                "to": str(options.to),
                "confirmed": counts.confirmed,
                "sent_bytes": counts.sent_bytes,
                "left": [each.name for each in left],
                "problem": counts.problem,
            }
        )
    else:
        size = size_text(sum(each.size for each in left))
        print_line(
            f"{count_text(counts.confirmed, 'file')} uploaded ({size_text(counts.sent_bytes)} sent), "
            f"{count_text(len(left), 'file')} left ({size})"
        )
    return 1 if left else 0
