"""``igtl-gateway sync``: the lags between the streams of a recording, and their correction."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from igtl_gateway.addon import NS_PER_S, ConfigError, GatewayError, streams_expected
from igtl_gateway.addon.notes import StampCorrection
from igtl_gateway.addon.reading import Kind, Recording, Stream, open_recording
from igtl_gateway.addon.terminal import (
    aligned,
    clear_live_line,
    count_text,
    counted,
    is_terminal,
    print_json,
    print_line,
)
from igtl_gateway.addon.writing import check_target, write_text, written
from igtl_gateway.addons.sync import plot
from igtl_gateway.addons.sync.correcting import write_corrected
from igtl_gateway.addons.sync.correction import is_corrected
from igtl_gateway.addons.sync.curves import lag_text
from igtl_gateway.addons.sync.folder import Measured, recordings_of, run_folder
from igtl_gateway.addons.sync.lag import Lag, Pair, Verdict, measure_lag, measure_together
from igtl_gateway.addons.sync.lags import POSES_BY_NAME, TRACKING, movement, movements, too_few, tools
from igtl_gateway.addons.sync.signal import Signal


def run(options: argparse.Namespace) -> int:
    _check(options)
    if recordings := recordings_of(options.file):
        _check_folder(options)

        def measure(path: Path) -> Measured:
            fixed, lags, unreadable, _ = _measured([path], options)
            return fixed, lags, unreadable

        return run_folder(options.file, recordings, measure, lag_facts, as_json=options.json)
    paths = [path for path in (options.file, options.other) if path is not None]
    fixed, lags, unreadable, pairs = _measured(paths, options)
    if options.plot:
        chart = plot.lag_chart(fixed, lags, unreadable)
        with written(options.plot, overwrite=options.overwrite) as path:
            write_text(path, chart)
    good = all(lag.verdict.has_lag for _, lag in lags)
    applied = _apply(options, fixed, pairs, *lags[0]) if options.apply and good else None
    if options.json:
        facts = {"file": str(options.file), "fixed": fixed.name, "lags": [lag_facts(*each) for each in lags]}
        left = [{"stream": key, "reason": why} for key, why in unreadable.items()]
        print_json(facts | ({"applied": applied.facts()} if applied else {}) | {"unreadable": left})
    else:
        _print(fixed, lags)
        for key, why in unreadable.items():
            print_line(f"unreadable: {key}: {why}")
        if options.apply:
            print_line(applied.text() if applied else f"{options.output}: not written: there is no lag to correct")
    return 0 if good and not unreadable else 1


def _measured(
    paths: Sequence[Path], options: argparse.Namespace
) -> tuple[Signal, list[tuple[Signal, Lag]], dict[str, str], list[tuple[Signal, Signal]]]:
    """Return the reference, the others with their lags, the unreadable streams with the reason, and further pairs."""
    with ExitStack() as stack:
        opened = [stack.enter_context(open_recording(path)) for path in paths]
        for warning in chain.from_iterable(each.warnings for each in opened):
            if is_terminal(error=True):  # of a folder
                clear_live_line(error=True)
            print_line(f"note: {warning}", error=True)
        signals, unreadable = _signals(opened, options)
        pairs = _pairs(opened, options)
    if len(signals) < 2:
        raise too_few(signals, unreadable, paths[0])
    fixed, *others = signals
    return fixed, [(signal, _measure(fixed, signal, pairs, options)) for signal in others], unreadable, pairs


def _check_folder(options: argparse.Namespace) -> None:
    for name, value in (("--with", options.other), ("--plot", options.plot), ("--apply", options.apply)):
        if value:
            raise ConfigError(f"{name}: found it with a folder, expected one recording")


def _check(options: argparse.Namespace) -> None:
    for name in ("max_lag", "cut_off"):
        value = getattr(options, name)
        if value is not None and not 0 < value < math.inf:
            raise ConfigError(f"--{name.replace('_', '-')}: found {value:g}, expected more than 0")
    if options.pair and len(options.streams) != 2:
        raise ConfigError(f"--pair: found {counted(len(options.streams), 'stream')}, expected two before it")
    if options.apply != (options.output is not None):
        raise ConfigError("--apply: found it or -o OUT alone, expected both")
    if options.apply and (len(options.streams) != 2 or options.other):
        raise ConfigError(f"--apply: found {counted(len(options.streams), 'stream')}, expected two of one file")
    if options.overwrite and not (options.output or options.plot):
        raise ConfigError("--overwrite: found neither -o nor --plot, expected one: the option has no effect here")
    for target in (options.output, options.plot):
        if target:
            check_target(target, overwrite=options.overwrite)
    if options.plot:
        plot.check_library()


def _signals(opened: Sequence[Recording], options: argparse.Namespace) -> tuple[list[Signal], dict[str, str]]:
    """Return the movements of the requested streams, or of all inputs that have one; unreadable ones of all → why."""
    chosen = [stream_named(opened, name) for name in options.streams] or [
        each[name] for each in opened for name in each
    ]
    if options.frame and not any(each.type in POSES_BY_NAME for each in chosen):
        raise ConfigError(f"--frame {options.frame}: found no stream with several poses: the option has no effect here")
    if options.streams:
        return [_movement(stream_named(opened, name), options) for name in options.streams], {}
    return movements(opened, frame=options.frame, line=options.line)


def stream_named(opened: Sequence[Recording], name: str) -> Stream:
    """Return a stream of the first recording that has it.  Raises ConfigError."""
    for each in opened:
        if name in each:
            return each[name]
    files = ", ".join(str(each.path) for each in opened)
    expected = streams_expected([name], chain(*opened), opened[0].path)
    raise ConfigError(f"{files}: found no stream {name!r}, {expected}")


def _pairs(opened: Sequence[Recording], options: argparse.Namespace) -> list[tuple[Signal, Signal]]:
    """Return the movements of the further pairs."""
    return [
        (_movement(stream_named(opened, fixed), options), _movement(stream_named(opened, moving), options))
        for fixed, moving in options.pair
    ]


def _measure(fixed: Signal, moving: Signal, pairs: Sequence[tuple[Signal, Signal]], options: argparse.Namespace) -> Lag:
    if not pairs:
        return measure_lag(fixed, moving, max_lag_s=options.max_lag, cut_off_hz=options.cut_off)
    return measure_together([(fixed, moving), *pairs], max_lag_s=options.max_lag, cut_off_hz=options.cut_off)


def _movement(stream: Stream, options: argparse.Namespace) -> Signal:
    frame = options.frame if stream.type in POSES_BY_NAME else ""
    return movement(stream, frame=frame, line=options.line)


def lag_facts(signal: Signal, lag: Lag) -> dict[str, Any]:
    """Return a lag for JSON."""
    facts = {key: value for key, value in asdict(lag).items() if key != "search"}
    facts["pairs"] = [asdict(pair) | {"verdict": pair.verdict.name.lower()} for pair in lag.pairs]
    clock = "source" if signal.is_stamped else "gateway"
    reason = lag.verdict.value
    return {
        "stream": signal.name, "clock": clock, **_finite(facts), "verdict": lag.verdict.name.lower(), "reason": reason,
    }  # fmt: skip


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    match value:
        case dict():
            return {key: _finite(part) for key, part in value.items()}
        case list() | tuple():
            return [_finite(part) for part in value]
        case float() if not math.isfinite(value):
            return None
        case _:
            return value


def _print(fixed: Signal, lags: Sequence[tuple[Signal, Lag]]) -> None:
    print_line(f"behind {fixed.name}: {count_text(len(fixed.times_ns), 'sample')}, {1 / fixed.period_s:.1f} Hz")
    rows = [("stream", "lag", "95 %", "R²", "skew", "samples", ""), *(_row(*each) for each in lags)]
    print_line(*aligned(rows, left=1, text=True))
    unstamped = [signal.name for signal in (fixed, *(signal for signal, _ in lags)) if not signal.is_stamped]
    if unstamped:
        print_line(f"no stamps in {', '.join(unstamped)}: gateway times are used, so its lag contains the transport")
    for signal, lag in lags:
        for line in _remarks(lag):
            print_line(f"{signal.name}: {line}")


def _row(signal: Signal, lag: Lag) -> tuple[str, ...]:
    if not lag.verdict.has_lag:
        return signal.name, "", "", _number(lag.r2, ".3f"), "", f"{lag.samples:,}", lag.verdict.value
    return (
        signal.name,
        f"{lag.lag_s * 1e3:+.1f} ms",
        f"{lag.low_s * 1e3:+.1f} to {lag.high_s * 1e3:+.1f}",
        f"{lag.r2:.3f}",
        f"{lag.skew_ppm:+.0f} ppm" if lag.has_skew else "",
        f"{lag.samples:,}",
        "",
    )


def _remarks(lag: Lag) -> Iterator[str]:
    if lag.verdict.has_lag and len(lag.windows) > 1:
        spread = [window.lag_s * 1e3 for window in lag.windows]
        text = f"{min(spread):+.1f} to {max(spread):+.1f} ms in {counted(len(spread), 'window')}"
        yield f"{lag.verdict.value}: {text}" if lag.verdict.name == "VARIES" else text
    if lag.verdict.has_lag and not math.isnan(lag.period_s):
        yield f"period {lag.period_s:.2f} s; this is the lag if it is below a quarter of it, as --max-lag states"
    elif not math.isnan(lag.period_s):
        yield (
            f"period {lag.period_s:.2f} s; move irregularly, add another movement (--pair), "
            f"or state that the lag is below a quarter of it (--max-lag {math.floor(lag.period_s / 4 * 100) / 100:g})"
        )
    if lag.verdict is Verdict.AT_EDGE:
        yield "search further (--max-lag)"
    if lag.verdict is Verdict.CONTRADICTORY and lag.windows:
        yield f"{', '.join(f'{window.lag_s * 1e3:+.1f}' for window in lag.windows)} ms in windows"
    for pair in lag.pairs:
        yield f"{pair.fixed} and {pair.moving}: {_role(pair)}"
    if not math.isnan(lag.other_s):
        yield f"{lag.lag_s * 1e3:+.0f} ms and {lag.other_s * 1e3:+.0f} ms are similar"


def _role(pair: Pair) -> str:
    """What a pair contributes to the lag of several."""
    if math.isnan(pair.r2):
        return pair.verdict.value
    period = "" if math.isnan(pair.period_s) else f", period {pair.period_s:.2f} s"
    return f"R² {pair.r2:.3f}{period}"


def _number(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)


@dataclass(frozen=True, slots=True)
class _Applied:
    """A corrected session.

    Attributes:
        out: the file.
        streams: the corrected streams.
        again: the lag in the file.
        is_verified: whether the outputs of the gateway were verified; an import has none.
    """

    out: Path
    streams: tuple[Signal, ...]
    again: Lag
    is_verified: bool

    def facts(self) -> dict[str, Any]:
        return {"out": str(self.out), "lag": lag_facts(self.streams[0], self.again), "verified": self.is_verified}

    def text(self) -> str:
        names = ", ".join(each.name for each in self.streams)
        is_stamped = all(each.is_stamped for each in self.streams)
        stamps = f"the stamps of {names}" if is_stamped else f"the gateway times of {names}, as its stamps,"
        proof = "the session verifies" if self.is_verified else "an import has no outputs to verify"
        measured = f"measured again, the lag is {self.again.lag_s * 1e3:+.1f} ms"
        where = "header.stamp is corrected where it is read or exported, the recorded bytes stay"
        return f"{self.out}: {stamps} are corrected; {measured}; {proof}; {where}"


def _frame_of(stream: Stream, signal: Signal, options: argparse.Namespace) -> str:
    """The frame whose stamps are corrected, of a topic with poses of several frames; ``""`` for all messages.

    Raises GatewayError where the stamps of one frame cannot be corrected alone.
    """
    if not options.frame or stream.type not in POSES_BY_NAME:
        return ""
    if stream.type in TRACKING:
        others = {tool for message in stream.messages() for tool in tools(message)} - {options.frame}
        if others:
            raise GatewayError(
                f"{stream.key}: found {', '.join(sorted(others)[:5])} in the messages with {options.frame}, "
                "whose stamp they share, expected one tool"
            )
        return ""
    if not signal.is_stamped:
        raise GatewayError(f"{stream.key}: found transforms of {options.frame} without a stamp, expected header.stamp")
    return str(options.frame)


def _apply(
    options: argparse.Namespace, fixed: Signal, pairs: Sequence[tuple[Signal, Signal]], moving: Signal, lag: Lag
) -> _Applied:
    """Write the corrected session.  Raises GatewayError if the lag is still there; then there is no file."""
    low_ns, lag_ns, high_ns = (round(value * NS_PER_S) for value in (lag.low_s, lag.lag_s, lag.high_s))
    skew_ppm = lag.skew_ppm if lag.has_skew else 0.0
    found: list[Lag] = []

    def check(path: Path) -> None:
        with open_recording(path) as recording:
            (again, _), others = _signals([recording], options), _pairs([recording], options)
        found.append(_measure(again[0], again[1], others, options))
        if not is_corrected(lag, found[0]):
            raise GatewayError(
                f"{moving.name}: after the correction by {lag_text(lag)} found {lag_text(found[0])}, "
                f"expected no lag; {options.output} is not written"
            )

    corrections = {}
    with open_recording(options.file) as recording:
        for one, other in ((fixed, moving), *pairs):
            stream = recording[other.name]
            if not Kind(stream.direction).is_input:
                raise GatewayError(f"{stream.key}: found an output of the gateway, expected a stream that it received")
            behind = recording[one.name]
            frame = _frame_of(stream, other, options)
            corrections[stream.name, stream.type] = StampCorrection(
                other.name, one.name, lag_ns, low_ns, high_ns, skew_ppm, lag.middle_ns, other.is_stamped,
                stream.name, stream.type, behind.name, behind.type, frame,
            )  # fmt: skip
    verified = write_corrected(options.file, options.output, corrections, check=check, overwrite=options.overwrite)
    return _Applied(options.output, tuple(each for _, each in ((fixed, moving), *pairs)), found[0], verified)
