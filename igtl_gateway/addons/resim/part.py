"""The part of a recording on which programs run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.reading import Moment, SessionFile, check_part, marks_of, to_ns
from igtl_gateway.addons.resim.engine import ResimOptions


def windowed(
    settings: ResimOptions, recording: Path, start: Moment | None, end: Moment | None, *, prefix: str = ""
) -> ResimOptions:
    """Return the settings with the part of a recording from ``start`` on and before ``end``.

    Args:
        settings: the settings.
        recording: the recording.
        start, end: as of ``Recording.between``; None: of the recording.
        prefix: what errors have before the names ``start`` and ``end``.

    Raises:
        ConfigError: a moment cannot be read, or nothing is in the part.
    """
    if start is None and end is None:
        return settings
    with SessionFile.open(recording) as file:
        marks = partial(marks_of, file)
        since_ns, until_ns = (
            None if value is None else to_ns(value, file.start_ns, file.end_ns, f"{prefix}{name}", marks)
            for name, value in (("start", start), ("end", end))
        )
        try:
            check_part(since_ns, until_ns, file.start_ns, file.end_ns, is_empty_part=True)
        except ConfigError as error:
            raise ConfigError(f"{prefix}{str(error).removeprefix('--')}") from None
    last_ns = settings.until_ns if until_ns is None else until_ns - 1
    return replace(settings, since_ns=since_ns or 0, until_ns=last_ns)
