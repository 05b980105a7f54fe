"""Checks pictures in the tables of a data set: PNG or JPEG in each row, as LeRobot writes them without videos.

Those that count for the statistics are decoded.  Depth in TIFF is not: of it the form alone is checked.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.messages import JPEG, PNG, decoded_still
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import Deadline
from igtl_gateway.addons.lerobot.checking_stats import StatsCheck
from igtl_gateway.addons.lerobot.features import IMAGE, IMAGE_COLUMN, picture_size
from igtl_gateway.addons.lerobot.reading import FoundDataSet, FoundEpisode
from igtl_gateway.addons.lerobot.stats import PictureStats, sampled

#: First bytes → format; "": one that is not decoded.
_FORMS = {b"\x89PNG": PNG, b"\xff\xd8\xff": JPEG, b"II*\0": "", b"MM\0*": ""}


def check_images(
    found: FoundDataSet, episode: FoundEpisode, table: pa.Table, stats: StatsCheck, deadline: Deadline
) -> Iterator[str]:
    """Yield what is wrong in the pictures of an episode, of which ``table`` are the rows.  Raises LimitExceeded."""
    for name, feature in found.info["features"].items():
        if feature["dtype"] != IMAGE or name not in table.schema.names or table[name].type != IMAGE_COLUMN:
            continue
        place = f"episode {episode.index}: {name}"
        cells = [each for chunk in table[name].chunks for each in chunk.field("bytes")]
        wrong = [row for row, cell in enumerate(cells) if not cell.is_valid or _form(cell) is None]
        if wrong:
            more = f" ({count_text(len(wrong), 'frame')})" if wrong[1:] else ""
            yield f"{place}: frame {wrong[0]}: found no PNG, JPEG or TIFF, expected one{more}"
            continue
        seen = PictureStats()
        damage = _decoded(cells, picture_size(feature), seen, place, deadline)
        yield from [damage] if damage else stats.pictures(episode, name, seen)


def _form(cell: Any) -> str | None:
    start = cell.as_buffer()[:4].to_pybytes()
    return next((form for magic, form in _FORMS.items() if start.startswith(magic)), None)


def _decoded(cells: list[Any], size: tuple[int, int], seen: PictureStats, place: str, deadline: Deadline) -> str:
    """Add the pictures that count to ``seen``; return what is wrong in the first one that is not as it should be."""
    for row in sampled(len(cells)).tolist():
        form = _form(cells[row])
        if not form:
            break
        deadline.check(place)
        try:
            picture = decoded_still(form, cells[row].as_py())
        except ConversionError as error:
            return f"{place}: frame {row}: {error}"
        if picture.shape[:2] != size:
            rows, columns = picture.shape[:2]
            return f"{place}: frame {row}: found {columns} × {rows} pixels, expected {size[1]} × {size[0]}"
        if picture.dtype == np.uint8:
            seen.add(picture)
    return ""
