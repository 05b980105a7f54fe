"""``igtl-gateway cohort``: a verb over many sessions, questions to the tables, and a report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import ConfigError
from igtl_gateway.addon.processes import ADDONS, check_present, extras, usable_cpus
from igtl_gateway.addon.terminal import (
    add_json,
    add_output,
    add_overwrite,
    aligned,
    command,
    count_text,
    counted,
    default,
    output_file,
    print_json,
    print_line,
    print_next,
)
from igtl_gateway.addon.writing import check_target, write_text, written
from igtl_gateway.addons.cohort.ends import EXPORT, VERB_NAMES
from igtl_gateway.addons.cohort.progress import Progress

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.run import RunPlace

EXAMPLES = """\
  # streams, times and rates of all sessions in and below a folder
  igtl-gateway cohort info sessions -o study
  # does every session verify?  Eight files at a time
  igtl-gateway cohort verify 'sessions/**/*.mcap' -o study --workers 8
  # sessions of an object store, on a cluster; credentials: AWS_ACCESS_KEY_ID …
  igtl-gateway cohort review s3://bucket/2026 -o study \\
      --scheduler tls://cluster:8786 --tls-ca ca.pem --tls-cert me.pem \\
      --tls-key me.key

  # one training set for LeRobot of all sessions, by four programs
  igtl-gateway cohort export sessions --recipe recipe.toml -o set \\
      --workers 4

  # questions to the tables, and one page about them
  igtl-gateway cohort query \\
      "SELECT rule, count(*) n FROM findings GROUP BY rule" -o study
  igtl-gateway cohort report -o study --html study.html

What is done is not done again.  Exit code 0: every file has a result;
1: a file has none (see the table tasks), or outputs differ, or lint finds
errors, or no file has what the options name.
Tables and columns: docs/how-to/cohort.md"""

QUERY, REPORT = "query", "report"
_FIRST_QUESTION = "SELECT status, count(*) FROM tasks GROUP BY 1"
_ACTIONS = (*VERB_NAMES, EXPORT, QUERY, REPORT)
#: Verb → options that only it has.
_OF_A_VERB = {"review": ("plan", "cloud", "tool"), "sync": ("stream", "pair", "max_lag")}
_NAMES = ("plan", "cloud", "tool", "stream", "pair")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", metavar="VERB", choices=_ACTIONS, help=f"one of {', '.join(_ACTIONS)}")
    parser.add_argument(
        "sources",
        metavar="SOURCE",
        nargs="*",
        help="files, folders, globs and URLs (s3://, gs://, az://, https://); query: the SQL",
    )
    add_output(parser, "folder of the tables, or of the training set", metavar="DIR", required=True)
    add_json(parser)
    parser.add_argument("--csv", type=output_file(".csv"), metavar="FILE", help="query: write the answer as CSV")
    parser.add_argument(
        "--parquet", type=output_file(".parquet"), metavar="FILE", help="query: write the answer as Parquet"
    )
    parser.add_argument("--recipe", type=Path, metavar="FILE", help="export: the recipe of the training set")
    parser.add_argument(
        "--append", action="store_true", help="export: add the sessions to the training set of -o, by its recipe"
    )
    parser.add_argument("--html", type=output_file(".html"), metavar="FILE", help="report: the page to write")
    add_overwrite(parser)
    group = parser.add_argument_group("where the files are read")
    group.add_argument(
        "--workers", type=int, metavar="N", help="files at a time on this machine " + default("one for each core")
    )
    group.add_argument("--scheduler", default="", metavar="ADDRESS", help="scheduler of Dask: tcp://… or tls://…")
    group.add_argument("--tls-ca", default="", metavar="FILE", help="certificate of the cluster's authority")
    group.add_argument("--tls-cert", default="", metavar="FILE", help="own certificate for the cluster")
    group.add_argument("--tls-key", default="", metavar="FILE", help="own key for the cluster")
    group.add_argument("--timeout", type=float, default=600.0, metavar="S", help="time for a file " + default(600))
    group.add_argument(
        "--memory-mib", type=int, default=2048, metavar="N", help="memory of a worker's data " + default(2048)
    )
    group = parser.add_argument_group("review and sync")
    group.add_argument("--plan", default="", metavar="TOPIC", help="topic of the plan")
    group.add_argument("--cloud", default="", metavar="TOPIC", help="topic of the point cloud")
    group.add_argument("--tool", default="", metavar="TOPIC", help="topic or frame of the tool")
    group.add_argument(
        "--stream",
        action="append",
        default=[],
        metavar="STREAM",
        help="stream whose lag to measure; the lags are those behind the first one (repeatable)",
    )
    group.add_argument(
        "--pair",
        nargs=2,
        action="append",
        default=[],
        metavar="STREAM",
        help="with two --stream: two more streams with the same lag, see sync (repeatable)",
    )
    group.add_argument("--max-lag", type=float, metavar="S", help="search lags up to this, as --max-lag of sync")


def run(options: argparse.Namespace) -> int:
    with extras.in_use("cohort"):
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    for name, action in (("csv", QUERY), ("parquet", QUERY), ("html", REPORT), ("recipe", EXPORT), ("append", EXPORT)):
        if getattr(options, name) and options.action != action:
            raise ConfigError(f"--{name}: found it with {options.action}, expected it with {action}")
    if options.action == QUERY:
        return _run_query(options)
    if options.overwrite and not (options.csv or options.parquet or options.html):
        raise ConfigError("--overwrite: found none of --csv, --parquet and --html, expected one of them")
    return _run_report(options) if options.action == REPORT else _run_files(options)


def _run_query(options: argparse.Namespace) -> int:
    if len(options.sources) != 1:
        raise ConfigError(f"cohort query: found {counted(len(options.sources), 'argument')}, expected one: the SQL")
    from igtl_gateway.addons.cohort.query import asking, of_table, write_answer

    [sql] = options.sources
    targets = [each for each in (options.csv, options.parquet) if each]
    for target in targets:
        check_target(target, overwrite=options.overwrite)
    with asking(options.output) as questions:
        table = questions.table(sql) if targets else None
        answer = questions.answer(sql) if table is None else of_table(table) if options.json else None
    for target in targets:
        with written(target, overwrite=options.overwrite) as path:
            write_answer(table, path, parquet=target is options.parquet)
    if answer is None:
        return 0
    if options.json:
        print_json({"columns": answer.columns, "rows": answer.rows})
    else:
        rows = [answer.columns, *([_cell(cell) for cell in row] for row in answer.cells)]
        print_line(*aligned(rows, left=len(answer.columns), indent=""))
    return 0


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _run_report(options: argparse.Namespace) -> int:
    if options.sources or options.html is None:
        raise ConfigError("cohort report: expected no source, and the page to write by --html")
    from igtl_gateway.addons.cohort.query import asking
    from igtl_gateway.addons.cohort.report import page

    check_target(options.html, overwrite=options.overwrite)
    with asking(options.output) as questions, written(options.html, overwrite=options.overwrite) as path:
        write_text(path, page(questions, str(options.output)))
    if options.json:
        print_json({"out": str(options.output), "html": str(options.html)})
    else:
        print_line(f"{options.html}: report of {options.output}")
    return 0


def _run_files(options: argparse.Namespace) -> int:
    _check(options)
    if options.action == EXPORT:
        return _run_export(options)
    from igtl_gateway.addons.cohort.results import Results
    from igtl_gateway.addons.cohort.run import RunSettings
    from igtl_gateway.addons.cohort.running import run_cohort
    from igtl_gateway.addons.cohort.sources import locate

    results = Results(options.output)
    files = locate(options.sources)
    work = RunSettings(options.action, _settings(options), options.limit, options.memory_mib << 20, options.timeout)
    where = _place(options)
    with Progress(quiet=options.json) as progress:
        summary = run_cohort(work, files, results, where, progress)
    # without a name, nothing to do is a result: a folder may have sessions without a plan
    is_nowhere = summary.is_nothing and any(getattr(options, name) for name in _NAMES)
    if options.json:
        facts = {"files": summary.files, "done_before": summary.before, "ends": dict(sorted(summary.ends.items()))}
        print_json({"out": str(options.output), "verb": work.verb, **facts, "different": summary.different})
    else:
        print_line(f"{options.output}: {count_text(summary.files, 'file')}, {summary.before:,} done before")
        for status, number in sorted(summary.ends.items()):
            reason = summary.reasons.get(status)
            print_line(f"  {number:>7,} {status.replace('_', ' ')}" + (f": {reason}" if reason else ""))
        if is_nowhere:
            print_line("  no file has what the options name")
        if summary.different:
            what = {"verify": "differences", "sync": "unreadable streams"}.get(work.verb, "errors")
            print_line(f"  {summary.different:>7,} with {what}")
        print_next(
            (command("cohort", QUERY, _FIRST_QUESTION, "-o", options.output), "ask the tables"),
            (command("cohort", REPORT, "-o", options.output, "--html", "report.html"), "write a page about them"),
        )
    return int(bool(summary.failed or summary.different or is_nowhere))


def _run_export(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.cohort.exporting import LEROBOT, run_export

    check_present(LEROBOT)
    if options.recipe is None and not options.append:
        raise ConfigError("cohort export: found no --recipe, expected the recipe of the training set, or --append")
    return run_export(options, _place(options))


def _place(options: argparse.Namespace) -> RunPlace:
    from igtl_gateway.addons.cohort.run import RunPlace

    return RunPlace(
        options.workers or usable_cpus(), options.scheduler, options.tls_ca, options.tls_cert, options.tls_key
    )


def _check(options: argparse.Namespace) -> None:
    if options.action in ADDONS:  # review, sync: before any file is read
        check_present(options.action)
    if not options.sources:
        raise ConfigError(f"cohort {options.action}: found no source, expected files, folders, globs or URLs")
    for name, value, least in (
        ("--workers", 1 if options.workers is None else options.workers, 1),
        ("--memory-mib", options.memory_mib, 64),
    ):
        if value < least:
            raise ConfigError(f"{name}: found {value}, expected {least} or more")
    for verb, names in _OF_A_VERB.items():
        for name in names:
            if options.action != verb and getattr(options, name):
                flag = f"--{name.replace('_', '-')}"
                raise ConfigError(f"{flag}: found {options.action}, expected {verb}: the option has no effect here")
    if options.pair and len(options.stream) != 2:
        raise ConfigError(f"--pair: found {len(options.stream)} of --stream, expected two")
    for name, seconds in (("--timeout", options.timeout), ("--max-lag", options.max_lag)):
        if seconds is not None and not 0 < seconds < 1e9:
            raise ConfigError(f"{name}: found {seconds:g}, expected more than 0 and less than 1e9")
    tls = [bool(each) for each in (options.tls_ca, options.tls_cert, options.tls_key)]
    if any(tls) and not (all(tls) and options.scheduler.startswith("tls://")):
        raise ConfigError("--tls-ca, --tls-cert, --tls-key: expected all three, with --scheduler tls://…")


def _settings(options: argparse.Namespace) -> dict[str, Any]:
    """The settings that decide about the rows of this verb."""
    match options.action:
        case "review":
            return {"plan": options.plan, "cloud": options.cloud, "tool": options.tool}
        case "sync":
            streams: Sequence[str] = options.stream
            return {"streams": list(streams), "pairs": options.pair, "max_lag_s": options.max_lag}
        case _:
            return {}
