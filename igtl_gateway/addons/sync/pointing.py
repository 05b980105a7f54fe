"""Streams of a recording that are late behind another one with the same movement: what ``doctor`` reports.

Only the begin of a recording is read, and a stream counts only if its whole interval is beyond the limit.
"""

from __future__ import annotations

from pathlib import Path

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addons.sync.lag import Verdict, measure_lag
from igtl_gateway.addons.sync.lags import movements

#: A lag below this is that of a usual connection.
LEAST_S = 0.030
#: Seconds of the recording, messages of a stream, and streams that are looked at.
_MOST_S, _MOST_MESSAGES, _MOST_STREAMS = 60.0, 6_000, 12


def late_streams(path: Path) -> list[tuple[str, str, float]]:
    """Return (stream, the one that it is behind, lag in s; negative: ahead) of streams with the same movement."""
    try:
        with open_recording(path) as recording:
            begin = recording.between(0.0, _MOST_S) if recording.duration > _MOST_S else recording
            chosen = {key: stream for key, stream in begin.items() if stream.count <= _MOST_MESSAGES}
            signals = movements([chosen])[0][:_MOST_STREAMS]
    except (GatewayError, ConfigError):
        return []
    if len(signals) < 2:
        return []
    fixed, *others = signals
    found = []
    for signal in others:
        if not signal.is_stamped or not fixed.is_stamped:
            continue
        lag = measure_lag(fixed, signal)
        if lag.verdict is Verdict.MEASURED and (lag.low_s > LEAST_S or lag.high_s < -LEAST_S):
            found.append((signal.name, fixed.name, lag.lag_s))
    return found
