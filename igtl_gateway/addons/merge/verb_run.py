"""``igtl-gateway merge``: make one session of the recordings of several recorders."""

from __future__ import annotations

import argparse
import math
from contextlib import ExitStack
from pathlib import Path

from igtl_gateway.addon import NS_PER_S, ConfigError, GatewayError
from igtl_gateway.addon.messages import topic_token
from igtl_gateway.addon.reading import SessionFile, open_recording
from igtl_gateway.addon.terminal import count_text, counted, print_json, print_line, print_merge, size_text
from igtl_gateway.addon.untrusted import is_same
from igtl_gateway.addon.writing import Method, check_target, open_new, written
from igtl_gateway.addons.merge.merging import Source, merge
from igtl_gateway.addons.merge.offsets import ClockOffset, Piece


def run(options: argparse.Namespace) -> int:
    check_target(options.output, overwrite=options.overwrite)
    if options.extract is not None:
        return _extract(options)
    sources = [_source(text) for text in options.files]
    for source in sources:
        if is_same(options.output, source.path):
            raise ConfigError(f"{options.output}: found a recording that is merged, expected another file to write to")
    given = dict(_offset(text) for text in options.offset)
    if options.max_lag is not None and not options.sync:
        raise ConfigError("--max-lag: found no --sync STREAM STREAM, expected it: the option has no effect here")
    if options.sync:
        if len(sources) != 2 or given:
            raise ConfigError("--sync: expected two recordings and no --offset")
        given = {_name(sources[1]): _measured(sources, options)}
    found = merge(sources, options.output, given=given, overwrite=options.overwrite)
    if options.json:
        print_json(found)
    else:
        print_line(
            f"{options.output}: {count_text(found['messages'], 'message')} of "
            f"{counted(len(found['parts']), 'recording')}, "
            f"{size_text(options.output.stat().st_size)}"
        )
        print_merge(found)
    return 0


def _source(text: str) -> Source:
    """A recording, with its name if it has one; a file whose name contains an equals sign is a file."""
    name, equals, path = text.partition("=")
    if equals and not Path(text).exists():
        if topic_token(name) != name or not name:
            raise ConfigError(f"{text}: found the name {name!r}, expected letters, digits and _")
        return Source(name, Path(path))
    return Source("", Path(text))


def _name(source: Source) -> str:
    return source.name or topic_token(source.path.stem)


def _offset(text: str) -> tuple[str, ClockOffset]:
    name, _, number = text.rpartition("=")
    try:
        seconds = float(number)
    except ValueError:
        seconds = math.nan
    if not name or not math.isfinite(seconds):
        raise ConfigError(f"--offset: found {text!r}, expected NAME=SECONDS such as planning=+0.0123")
    return name, ClockOffset(Method.GIVEN, (Piece(0, round(seconds * NS_PER_S)),))


def _measured(sources: list[Source], options: argparse.Namespace) -> ClockOffset:
    """The offset from the movement in a stream of each of two recordings, at the times when they recorded it."""
    from igtl_gateway.addons.sync.lag import measure_lag  # here: merge works without this add-on
    from igtl_gateway.addons.sync.lags import movement
    from igtl_gateway.addons.sync.verb_run import stream_named

    if options.max_lag is not None and not 0 < options.max_lag < math.inf:
        raise ConfigError(f"--max-lag: found {options.max_lag:g}, expected more than 0")
    with ExitStack() as stack:
        opened = [stack.enter_context(open_recording(source.path)) for source in sources]
        signals = [
            movement(stream_named([each], name), arrival=True) for each, name in zip(opened, options.sync, strict=True)
        ]
        lag = measure_lag(*signals, max_lag_s=options.max_lag)
    if not lag.verdict.has_lag:
        raise GatewayError(f"--sync {' '.join(options.sync)}: found no offset: {lag.verdict.value}")
    offset_ns, low_ns, high_ns = (round(each * NS_PER_S) for each in (lag.lag_s, lag.low_s, lag.high_s))
    slope = lag.skew_ppm * 1e3 if lag.has_skew else 0.0
    piece = Piece(lag.middle_ns + offset_ns, offset_ns, slope)
    return ClockOffset(
        Method.STREAMS, (piece,), offset_ns - low_ns, high_ns - offset_ns, lag.skew_low_ppm, lag.skew_high_ppm
    )


def _extract(options: argparse.Namespace) -> int:
    if len(options.files) != 1 or options.offset or options.sync:
        raise ConfigError("--extract: expected one merged session, and neither --offset nor --sync")
    with (
        SessionFile.open(options.files[0]) as file,
        written(options.output, overwrite=options.overwrite) as path,
        open_new(path) as out,
    ):
        file.extract(options.extract, out)
    size = options.output.stat().st_size
    if options.json:
        print_json({"file": str(options.output), "bytes": size, "part": options.extract})
    else:
        print_line(f"{options.output}: {size_text(size)}, part {options.extract}, as it was recorded")
    return 0
