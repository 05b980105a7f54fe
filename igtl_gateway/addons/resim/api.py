"""Re-simulation as a function: ``igtl_gateway.resim``."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path

from igtl_gateway.addon import NS_PER_MS, NS_PER_S, ConfigError, one_of
from igtl_gateway.addon.checking import Tolerance
from igtl_gateway.addon.reading import Moment, SessionFile
from igtl_gateway.addons.resim.engine import MOST_DELAY_S, Clocks, Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.judge import judge
from igtl_gateway.addons.resim.part import windowed
from igtl_gateway.addons.resim.recipe import command_of
from igtl_gateway.addons.resim.report import report_lines
from igtl_gateway.addons.resim.verdict import Difference, Verdict

#: A command as in a shell, its words, or with name, environment and folder.
AnyProgram = str | Sequence[str] | Program


@dataclass(frozen=True, slots=True)
class Resimulation:
    """What programs did on a recording; as a string, its verdict with the differences of each stream.

    Attributes:
        result: roles of the topics, and the runs with their outputs.
        verdict: determinism, and the comparison with the baseline or the recording.
    """

    result: RunResult
    verdict: Verdict

    @property
    def is_equal(self) -> bool:
        """Whether all runs are equal, and equal to the baseline or the recording."""
        return self.verdict.exit_code == 0

    @property
    def is_deterministic(self) -> bool:
        """Whether all runs came to their end and are equal, and no timer races an input."""
        return self.verdict.is_deterministic

    @property
    def race(self) -> str:
        """What depends on a timer, in a line; ``""`` for nothing.  The runs may be equal nevertheless."""
        return self.verdict.race.text(self.verdict.start_ns) if self.verdict.race else ""

    @property
    def inputs(self) -> int:
        """Number of recorded messages that the programs received in the first run."""
        return sum(self.result.runs[0].delivered.values())

    @property
    def first(self) -> Difference | None:
        """The first difference: stream, number, session time, field, mm and degrees."""
        return self.verdict.first

    @property
    def outputs(self) -> Path:
        """The session file with the outputs of the first run; there is one only with ``folder``."""
        return self.result.runs[0].outputs

    def __str__(self) -> str:
        return "\n".join(report_lines(self.result, self.verdict))


def resim(
    recording: Path | str,
    *programs: AnyProgram,
    start: Moment | None = None,
    end: Moment | None = None,
    runs: int = 3,
    baseline: Path | str | None = None,
    tolerance_mm: float = 0.0,
    tolerance_deg: float = 0.0,
    inputs: str | Sequence[str] = (),
    outputs: str | Sequence[str] = (),
    without: str | Sequence[str] = (),
    latency_ms: float = 0.0,
    lead_s: float = 0.0,
    permit_races: bool = False,
    any_start: bool = False,
    clocks: str = "shifted",
    wall_limit_s: float = 30.0,
    cpu_limit_s: float = 60.0,
    cwd: Path | str | None = None,
    folder: Path | str | None = None,
) -> Resimulation:
    """Run ROS 2 programs on a recording, in its time, and compare their outputs.

    Args:
        recording: the recording, or an MCAP file of rosbag2.
        programs: commands: ``"python planner.py"``, a list of words, or a ``Program``.
        start: run from this moment on, as of ``Recording.between``; None: from the beginning.  Programs begin without
            what came before, so compare with a ``baseline`` of the same part.
        end: run up to this moment; None: to the end.
        runs: how often to run.
        baseline: outputs of an earlier run, to compare with; None: the recording itself.
        tolerance_mm: what positions may differ from them.
        tolerance_deg: what rotations may differ from them.
        inputs: topics that the recording drives although a program publishes them; globs, or one.
        outputs: topics that it does not drive; globs, or one.
        without: topics that programs may ask for although nothing has them; globs, or one.
        latency_ms: of messages from program to program, in session time.
        lead_s: session time from the start of the programs to that of the recording.
        permit_races: whether a timer may race a topic, as of programs that sample by a timer deliberately.
        any_start: whether outputs must not depend on when the programs start.
        clocks: what the clocks outside of ROS show: "shifted" (session time, but ``time.time()`` is on another day in
            each run), "session" or "real".
        wall_limit_s: real time in which a program has to come to rest.
        cpu_limit_s: CPU time in which a program has to come to rest.
        cwd: where commands run; None: here.
        folder: where the outputs of all runs go, as ``run-1.mcap`` …; None: they are not kept.

    Returns:
        Verdict and runs; a program that ends, crashes or hangs is in ``verdict.fault``.

    Raises:
        ConfigError: an argument is out of range, a program cannot be started, or uses another middleware.
        Unavailable: the library is not built on this machine.
        RecordingError: the recording or the baseline cannot be read.
    """
    for name, value in (("tolerance_mm", tolerance_mm), ("tolerance_deg", tolerance_deg)):
        if not 0 <= value < inf:
            raise ConfigError(f"{name}: found {value!r}, expected 0 or more")
    for name, value, most in (("latency_ms", latency_ms, 1000 * MOST_DELAY_S), ("lead_s", lead_s, MOST_DELAY_S)):
        if not 0 <= value <= most:
            raise ConfigError(f"{name}: found {value!r}, expected 0 to {most}, a day")
    for name, value in (("wall_limit_s", wall_limit_s), ("cpu_limit_s", cpu_limit_s)):
        if not 0 < value < inf:
            raise ConfigError(f"{name}: found {value!r}, expected more than 0")
    if clocks not in (names := [each.value for each in Clocks]):
        raise ConfigError(f"clocks: found {clocks!r}, expected {one_of(clocks, names)}")
    options = ResimOptions(
        runs=runs,
        without=_globs(without),
        latency_ns=round(latency_ms * NS_PER_MS),
        lead_ns=round(lead_s * NS_PER_S),
        clocks=Clocks(clocks),
        inputs=_globs(inputs),
        outputs=_globs(outputs),
        wall_s=wall_limit_s,
        cpu_s=cpu_limit_s,
    )
    path = Path(recording)
    options = windowed(options, path, start, end)
    commands = [_program(each, cwd) for each in programs]
    if baseline:  # before the programs run
        SessionFile.open(Path(baseline)).close()
    with tempfile.TemporaryDirectory(prefix="igtl-resim-") as temporary:
        place = Path(folder or temporary)
        result = run(path, commands, options, place)
        reference = Path(baseline) if baseline else path
        tolerance = Tolerance(tolerance_mm, tolerance_deg)
        verdict = judge(
            result,
            commands,
            options,
            reference=reference,
            tolerance=tolerance,
            permits_races=permit_races,
            wants_any_start=any_start,
        )
        return Resimulation(result, verdict)


def _globs(given: str | Sequence[str]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def _program(given: AnyProgram, cwd: Path | str | None) -> Program:
    if isinstance(given, Program):
        return given
    words = given if isinstance(given, str) else [str(word) for word in given]
    return Program(command_of("programs", words), folder=Path(cwd) if cwd else None)
