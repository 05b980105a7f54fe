"""The upload of ``igtl-gateway keep``: that of ``bridge --upload``, once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, SystemClock
from igtl_gateway.addon.reading import Note
from igtl_gateway.addon.terminal import count_text, print_json, print_line, size_text, stop_event
from igtl_gateway.addons.upload.place import upload_place
from igtl_gateway.addons.upload.uploading import CONFIRMED, Uploader

_LOOK_S = 0.2


def upload(folder: Path, values: Mapping[str, Any]) -> int:
    """Upload the recordings of a folder.  Returns the exit code: 1 if some are left."""
    place = upload_place(values["upload"])
    clock = SystemClock()
    with stop_event() as stop:

        def show(note: Note) -> None:
            if not values["json"]:
                print_line(note.text, error=note.code != CONFIRMED, flush=True, log=True)

        rate = values["upload_rate"] * 1e6
        uploader = Uploader(folder.absolute(), None, place, rate, clock, show, stop.is_set)
        counts = uploader.counts
        good_ns, confirmed = clock.monotonic_ns(), 0
        try:
            while not uploader.step() and not stop.wait(_LOOK_S):
                if counts.confirmed != confirmed or not counts.problem:
                    good_ns, confirmed = clock.monotonic_ns(), counts.confirmed
                    if not counts.problem:
                        break  # what still waits cannot be uploaded: notes state why
                if clock.monotonic_ns() - good_ns > values["patience"] * NS_PER_S:
                    break
            left = uploader.waiting()
        finally:
            uploader.close()
    if values["json"]:
        print_json(
            {
                "to": str(place),
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
