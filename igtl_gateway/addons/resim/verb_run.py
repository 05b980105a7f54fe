"""``igtl-gateway resim``: a recording drives ROS 2 programs again, and their outputs are compared."""

from __future__ import annotations

import argparse
import math
import shlex
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from igtl_gateway.addon import ConfigError, GatewayError, Unavailable
from igtl_gateway.addon.checking import Tolerance
from igtl_gateway.addon.reading import SessionFile, since_text
from igtl_gateway.addon.terminal import (
    aligned,
    cell,
    command,
    count_text,
    counted,
    duration_text,
    print_json,
    print_line,
    width,
)
from igtl_gateway.addon.untrusted import is_same
from igtl_gateway.addon.writing import check_target, open_new, write_bytes, written
from igtl_gateway.addons.resim.bisect import Step, bisect, bisection_facts
from igtl_gateway.addons.resim.causes import MOST_S
from igtl_gateway.addons.resim.coordinator import Roles
from igtl_gateway.addons.resim.engine import MOST_DELAY_S, Clocks, Program, ResimOptions, Run, RunResult, run_file
from igtl_gateway.addons.resim.engine import run as run_programs
from igtl_gateway.addons.resim.igtl_peer import IgtlRole, check_role
from igtl_gateway.addons.resim.judge import judge
from igtl_gateway.addons.resim.part import windowed
from igtl_gateway.addons.resim.recipe import read_recipe
from igtl_gateway.addons.resim.report import junit_xml
from igtl_gateway.addons.resim.verdict import StreamVerdict, Verdict, is_judged


def run(options: argparse.Namespace) -> int:
    if options.recipe and options.programs:
        raise ConfigError("found --recipe and a program behind --, expected one of them")
    programs = _programs_of(options)
    tolerance = _tolerance(options.tolerance)
    for name, most in (("latency", 1000 * MOST_DELAY_S), ("lead", MOST_DELAY_S)):
        if not 0 <= getattr(options, name) <= most:
            raise ConfigError(f"--{name}: found {getattr(options, name):g}, expected 0 to {most}, a day")
    for name in ("wall_limit", "cpu_limit"):
        if not 0 < getattr(options, name) < math.inf:
            raise ConfigError(f"--{name.replace('_', '-')}: found {getattr(options, name):g}, expected more than 0")
    if options.baseline:  # before the programs run
        SessionFile.open(options.baseline).close()
    for target in filter(None, (options.record, options.junit)):
        check_target(target, overwrite=options.overwrite)
        for source in filter(None, (*options.files, options.baseline)):
            if is_same(target, source):  # the outputs would be compared with themselves
                raise ConfigError(f"found {target} as a file to read and to write, expected two files")
    clocks = Clocks.SESSION if options.libc_clock else Clocks.REAL if options.real_clock else Clocks.SHIFTED
    settings = ResimOptions(
        runs=options.runs,
        latency_ns=round(options.latency * 1e6),
        lead_ns=round(options.lead * 1e9),
        clocks=clocks,
        inputs=tuple(options.input),
        outputs=tuple(options.output),
        swap_ties=options.swap_ties,
        without=tuple(options.without),
        wall_s=options.wall_limit,
        cpu_s=options.cpu_limit,
    )
    if options.build and not options.bisect:
        raise ConfigError("--build: has no effect without --bisect")
    if options.bisect:
        return _run_bisect(options, programs, settings, tolerance)
    if len(options.files) > 1:
        return _run_several(options, programs, settings, tolerance)
    [recording] = options.files
    with _outputs() as folder:
        result, verdict, kept = _run_one(options, recording, programs, settings, tolerance, folder)
    if options.json:
        print_json(facts_of(result, verdict) | {"outputs": [str(each) for each in kept]})
    else:
        _print_verdict(result, verdict)
        _print_steps(options, recording, verdict, kept)
    return verdict.exit_code


@contextmanager
def _outputs() -> Iterator[Path]:
    """A folder for the outputs of runs; deleted at the end."""
    with tempfile.TemporaryDirectory(prefix="igtl-resim-") as folder:
        yield Path(folder)


def _run_one(
    options: argparse.Namespace,
    recording: Path,
    programs: list[Program],
    settings: ResimOptions,
    tolerance: Tolerance,
    folder: Path,
    *,
    is_text: bool | None = None,
) -> tuple[RunResult, Verdict, list[Path]]:
    """Run the programs on a recording, and judge them; return the kept outputs of the first run, and of another one."""
    is_text = not options.json if is_text is None else is_text
    settings = windowed(settings, recording, options.start, options.end, prefix="--")
    done: list[Run] = []

    def take(one: Run) -> None:
        done.append(one)
        if is_text:
            _print_run(one)

    try:
        result = run_programs(
            recording, programs, settings, folder, on_roles=_print_roles if is_text else lambda roles: None, on_run=take
        )
    except KeyboardInterrupt:
        if _keep(options, folder):
            which = "of run 1" if done else "until then"
            print_line(f"{options.record}: the outputs {which}, complete")
        raise
    has_outputs = any(stream.messages for one in result.runs[:1] for stream in one.streams.values())
    if has_outputs:
        _keep(options, folder)
    verdict = judge(
        result,
        programs,
        settings,
        reference=options.baseline or recording,
        tolerance=tolerance,
        permits_races=options.permit_races,
        wants_any_start=options.any_start,
        on_search=_print_search if is_text else lambda: None,
    )
    if options.junit:
        with written(options.junit, overwrite=options.overwrite) as place:
            write_bytes(place, junit_xml(result, verdict, settings.outputs))
    differs = has_outputs and not verdict.fault and verdict.exit_code
    return result, verdict, _kept(options, folder, verdict) if differs else []


def _kept(options: argparse.Namespace, folder: Path, verdict: Verdict) -> list[Path]:
    """The outputs that differ, which stay: of the first run, and of that which differs from it."""
    numbers = [1, verdict.unequal_run] if verdict.unequal_run else [1]
    if numbers == [1] and options.record:
        return [options.record]
    place = Path(tempfile.mkdtemp(prefix="igtl-resim-outputs-"))
    return [Path(shutil.move(run_file(folder, number), place)) for number in numbers]


def _print_places(kept: Sequence[Path], record: Path | None) -> None:
    """Where outputs that differ stay, unless the user chose it."""
    places = dict.fromkeys(each.parent for each in kept if each != record)
    for place in places:
        print_line(f"outputs that differ stay until you remove them: rm -r {shlex.quote(str(place))}")


def _print_steps(options: argparse.Namespace, recording: Path, verdict: Verdict, kept: list[Path]) -> None:
    """What follows a difference: both sides in the viewer; of samples of a timer, a baseline."""
    steps = []
    # what programs know from before a part is in no baseline of the whole
    is_part = options.start is not None and bool(kept) and not verdict.unequal_run and not options.baseline
    if (verdict.is_sampled or is_part) and not options.record:
        words = [word for word in _words_of(options) if word]
        good = recording.with_name(f"{recording.stem}-{'part' if is_part else 'baseline'}.mcap").name
        once = "keep a baseline of this part, once" if is_part else "keep a baseline, once"
        steps += [(command("resim", recording, "--record", good, *words), once)]
        steps += [(command("resim", recording, "--baseline", good, *words), "compare later versions with it")]
    if kept:
        other = [] if verdict.unequal_run else [options.baseline or recording]
        steps.append((command("view", *other, *kept), "both in the viewer"))
    _print_places(kept, options.record)
    if steps:
        print_line("next", *(line for step, what in steps for line in (f"  {what}:", f"    {step}")))


def _words_of(options: argparse.Namespace) -> list[str]:
    """The words of the command behind the recording that decide what is run."""
    words: list[str] = []
    for name in ("start", "end"):
        words += [f"--{name}", getattr(options, name)] if getattr(options, name) is not None else []
    for name in ("input", "output", "without"):
        words += [word for each in getattr(options, name) for word in (f"--{name}", each)]
    words += ["--igtl-client"] * options.igtl_client
    words += ["--igtl-server", str(options.igtl_server)] if options.igtl_server is not None else []
    for name in ("latency", "lead", "link"):
        words += [f"--{name}", f"{getattr(options, name):g}"] if getattr(options, name) else []
    words += ["--libc-clock"] * options.libc_clock + ["--real-clock"] * options.real_clock
    return words + (["--recipe", str(options.recipe)] if options.recipe else options.programs)


#: Columns of the table of several recordings.
_HEADS = ("verdict", "inputs", "outputs")


def _run_several(
    options: argparse.Namespace, programs: list[Program], settings: ResimOptions, tolerance: Tolerance
) -> int:
    """A row for each recording; a line below for each that is not equal."""
    for name in ("record", "junit"):
        if getattr(options, name):
            raise ConfigError(f"--{name}: found {counted(len(options.files), 'recording')}, expected one")
    facts: list[dict[str, object]] = []
    lines: list[str] = []
    stay: list[Path] = []
    columns = max(len("recording"), width(str(path) for path in options.files))
    if not options.json:
        print_line(f"{cell('recording', columns)}  {_HEADS[0]:<18}{_HEADS[1]:>8} {_HEADS[2]:>8}")
    for path in options.files:
        try:
            with _outputs() as folder:
                result, verdict, kept = _run_one(options, path, programs, settings, tolerance, folder, is_text=False)
        except (ConfigError, Unavailable):
            raise
        except GatewayError as error:
            facts.append({"recording": str(path), "verdict": str(error), "exit_code": 2})
            word, counts = "cannot be judged", ("", "")
            lines.append(str(error))
        else:
            one = result.runs[0] if result.runs else None
            word = verdict.word
            counts = (f"{sum(one.delivered.values()):,}", f"{one.messages:,}") if one else ("", "")
            facts.append(facts_of(result, verdict) | {"outputs": [str(each) for each in kept]})
            if verdict.exit_code:
                lines.append(f"{path}: {verdict.line()}")
            if kept:
                stay += kept
                other = [] if verdict.unequal_run else [options.baseline or path]
                lines.append(f"  {command('view', *other, *kept)}")
        if not options.json:
            print_line(f"{cell(str(path), columns)}  {word:<18}{counts[0]:>8} {counts[1]:>8}", flush=True)
    failed = sum(bool(each["exit_code"]) for each in facts)
    if options.json:
        print_json({"recordings": facts})
    else:
        print_line(*lines)
        _print_places(stay, None)
        print_line(f"{len(facts) - failed:,} of {count_text(len(facts), 'recording')} as expected")
    return int(bool(failed))


def _keep(options: argparse.Namespace, folder: Path) -> bool:
    """Write ``--record``: the outputs of the first run, also if it was interrupted; return whether there are any."""
    outputs = run_file(folder, 1)
    if is_there := bool(options.record and outputs.is_file()):
        with (
            written(options.record, overwrite=options.overwrite) as place,
            outputs.open("rb") as source,
            open_new(place, "wb") as copy,
        ):
            shutil.copyfileobj(source, copy)
    return is_there


def _run_bisect(
    options: argparse.Namespace, programs: list[Program], settings: ResimOptions, tolerance: Tolerance
) -> int:
    for name in ("record", "junit", "baseline"):
        if getattr(options, name):
            raise ConfigError(f"--{name}: cannot be combined with --bisect, whose baseline are the outputs of GOOD")

    def tell(step: Step) -> None:
        print_line(f"{step.mark:4}  {step.commit.short}  {step.commit.subject}: {step.text}")

    if len(options.files) > 1:
        raise ConfigError(f"--bisect: found {counted(len(options.files), 'recording')}, expected one")
    [recording] = options.files
    result = bisect(
        options.bisect,
        options.build,
        recording,
        programs,
        windowed(settings, recording, options.start, options.end, prefix="--"),
        tolerance=tolerance,
        on_step=tell if not options.json else lambda step: None,
    )
    if options.json:
        print_json(bisection_facts(result))
    else:
        print_line(*result.lines())
    return result.exit_code


def _programs_of(options: argparse.Namespace) -> list[Program]:
    """The programs; sets ``permit_races`` if the recipe does.  Raises ConfigError."""
    is_igtl = options.igtl_client or options.igtl_server is not None
    if is_igtl and options.recipe:
        raise ConfigError("found --recipe and --igtl-client or --igtl-server, expected igtl in the recipe")
    if options.link and not is_igtl:
        raise ConfigError("--link: has no effect without --igtl-client or --igtl-server")
    if options.recipe:
        recipe = read_recipe(options.recipe)
        options.permit_races |= recipe.permits_races
        return recipe.programs
    if not options.programs:
        words = " ".join(map(str, options.files[1:]))
        question = (
            f"; if {words} is one: {command('resim', options.files[0], '--', *options.files[1:])}" if words else ""
        )
        raise ConfigError(f"found no program, expected one behind --{question}")
    programs = _programs(options.programs)
    if not is_igtl:
        return programs
    if len(programs) > 1:
        raise ConfigError("found several programs and --igtl-client or --igtl-server, expected a recipe with igtl")
    role = IgtlRole(options.igtl_server is not None, options.igtl_server or 0, options.link)
    check_role("--igtl-server", "--link", role)
    return [replace(programs[0], igtl=role)]


def _programs(words: list[str]) -> list[Program]:
    """The commands between the ``--``.  Raises ConfigError."""
    commands: list[list[str]] = []
    for word in words if words[:1] == ["--"] else ["--", *words]:
        if word == "--":
            commands.append([])
        else:
            commands[-1].append(word)
    if not all(command and command[0] for command in commands):
        raise ConfigError("found no program, expected one behind --")
    return [Program(tuple(command)) for command in commands]


def _tolerance(text: str) -> Tolerance:
    """Parse ``0.05mm,0.05deg``.  Raises ConfigError."""
    found: dict[str, float] = {}
    for part in text.split(",") if text else ():
        unit = next((unit for unit in ("mm", "deg") if part.strip().endswith(unit)), None)
        try:
            value = float(part.strip().removesuffix(unit or ""))
        except ValueError:
            value = math.nan
        if unit is None or not 0 <= value < math.inf or unit in found:
            wrong = text if unit in found else part
            raise ConfigError(f"--tolerance: found {wrong!r}, expected numbers with units such as 0.05mm,0.05deg")
        found[unit] = value
    return Tolerance(**found)


def _print_roles(roles: Roles) -> None:
    rows = [("input", name, count_text(count, "message")) for name, count in roles.inputs.items()]
    rows += [
        ("output", name, "also recorded" if name in roles.expected else "") for name in roles.outputs if is_judged(name)
    ]
    rows += [("missing", name, "asked for, but not recorded") for name in roles.missing]
    rows += [("not received", name, why) for name, why in roles.refused.items()]
    rows += [("service", name, count_text(count, "recorded answer")) for name, count in roles.answered.items()]
    rows += [("action", name, count_text(count, "recorded goal")) for name, count in roles.played.items()]
    rows += [("requests", name, count_text(count, "recorded request")) for name, count in roles.asked.items()]
    rows += [("no server", name, "called, but no program offers it") for name in roles.unserved]
    if roles.unused:
        rows.append(("not used", count_text(len(roles.unused), "recorded topic"), ""))
    print_line(*aligned(rows, left=3))


def _print_run(one: Run) -> None:
    session = duration_text(one.end_ns - one.start_ns)
    print_line(
        f"run {one.number}: {count_text(sum(one.delivered.values()), 'input')}, "
        f"{count_text(one.messages, 'output')}, {session} of session in {duration_text(one.seconds * 1e9)}"
    )
    for line in one.hints if one.number == 1 else ():
        print_line(f"faster: {line}")


def _print_search() -> None:
    print_line(f"runs differ: looking for the cause in shorter runs, for at most {MOST_S} s")


def _print_verdict(result: RunResult, verdict: Verdict) -> None:
    for name, count in result.runs[0].unserved.items() if result.runs else ():
        print_line(f"{name}: {count_text(count, 'request')} without an answer")
    for lost in result.runs[0].lost if result.runs else ():
        print_line(lost.text(verdict.start_ns))
    for line in result.runs[0].remarks if result.runs else ():
        print_line(f"weaker: {line}")
    if result.window[0] and not verdict.fault and verdict.exit_code:
        begin = since_text(result.zero_ns, result.window[0])
        print_line(f"the programs begin at {begin}, without what came before: compare with a baseline of the same part")
    for stream in verdict.between_runs or verdict.streams:
        if stream.first:
            print_line(f"  {stream.first.text(verdict.start_ns)}")
    print_line(verdict.line())


def _stream_facts(stream: StreamVerdict) -> dict[str, object]:
    counts = ("messages", "other_messages", "different", "missing", "extra", "late", "within")
    facts: dict[str, object] = {name: getattr(stream, name) for name in counts}
    return {"stream": stream.stream, "equal": stream.is_equal, "qos": not stream.requalified} | facts


def facts_of(result: RunResult, verdict: Verdict) -> dict[str, object]:
    """The result as JSON."""
    return {
        "recording": str(result.recording),
        "verdict": verdict.line(),
        "exit_code": verdict.exit_code,
        "fault": verdict.fault,
        "deterministic": verdict.is_deterministic,
        "sampled": verdict.is_sampled,
        "first": {"stream": verdict.first.stream, "what": verdict.first.what} if verdict.first else None,
        "streams": [_stream_facts(each) for each in verdict.between_runs or verdict.streams],
        "not_compared": verdict.uncompared,
        "not_published": verdict.unpublished,
        "race": verdict.race.text(verdict.start_ns) if verdict.race else "",
        "roles": asdict(result.roles) if result.roles else None,
        "runs": [
            {
                "number": one.number,
                "inputs": sum(one.delivered.values()),
                "outputs": {name: stream.messages for name, stream in one.streams.items()},
                "digests": {name: stream.digest for name, stream in one.streams.items()},
                "lost": [asdict(lost) for lost in one.lost],
                "events": one.events,
                "remarks": one.remarks,
                "hints": one.hints,
                "seconds": one.seconds,
                "start_seconds": one.start_s,
            }
            for one in result.runs
        ],
    }
