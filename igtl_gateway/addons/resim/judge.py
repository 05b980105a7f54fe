"""The verdict on runs with what explains it: the likely cause of a difference, or the race that equal runs do not show.

The verb and the Python API judge here alike; both need more runs, whose outputs are not kept.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from igtl_gateway.addon.checking import Tolerance
from igtl_gateway.addons.resim.causes import likely_cause
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult
from igtl_gateway.addons.resim.races import find_race
from igtl_gateway.addons.resim.verdict import Verdict, compare


def judge(
    result: RunResult,
    programs: Sequence[Program],
    options: ResimOptions,
    *,
    reference: Path,
    tolerance: Tolerance,
    permits_races: bool,
    wants_any_start: bool,
    on_search: Callable[[], None] = lambda: None,
) -> Verdict:
    """Compare the runs with each other and with a reference, and look for a cause or a race.

    Args:
        result: of ``engine.run``.
        programs, options: of these runs.
        reference: the recording, or the outputs of an earlier run.
        tolerance: that it allows.
        permits_races: whether a timer may race an input.
        wants_any_start: whether outputs must not depend on when the programs start.
        on_search: called before the search for a cause.
    """
    verdict = compare(result, reference=reference, tolerance=tolerance, outputs=options.outputs)
    verdict.permits_races, verdict.wants_any_start = permits_races, wants_any_start
    with tempfile.TemporaryDirectory(prefix="igtl-resim-") as folder:
        if verdict.unequal_run:
            on_search()
            verdict.cause = likely_cause(result.recording, programs, options, verdict, Path(folder))
        elif verdict.is_deterministic:
            verdict.race = find_race(result, programs, options, Path(folder))
    return verdict
