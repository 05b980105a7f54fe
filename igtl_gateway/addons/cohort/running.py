"""A run over a cohort: which files have to be read, their tasks, here or on Dask, and their rows in the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import NS_PER_S, SystemClock, __version__
from igtl_gateway.addons.cohort import ends
from igtl_gateway.addons.cohort.results import Results
from igtl_gateway.addons.cohort.run import KnownFile, Reply, Runner, RunPlace, RunSettings
from igtl_gateway.addons.cohort.scheduler import cluster
from igtl_gateway.addons.cohort.segments import in_segments, is_long
from igtl_gateway.addons.cohort.sources import Located, digest
from igtl_gateway.addons.cohort.task import Programs, failed, job_of

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.columns import Row

#: Rows are written after this time, or of this number of files: what a killed run loses.
_FLUSH_S, _FLUSH_FILES = 5, 500


@dataclass(slots=True)
class RunSummary:
    """A run so far.

    Attributes:
        files: of the cohort.
        before: of these, how many were done before and have not changed.
        ends: ``status`` → number of files of this run.
        reasons: ``status`` → the error of the first of these files.
        different: files whose outputs differ (``verify``), with a finding of severity error (``lint``), or
            an unreadable stream (``sync``).
        ends_before: ``status`` → number of files that had it before.
    """

    files: int
    before: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    reasons: dict[str, str] = field(default_factory=dict)
    different: int = 0
    ends_before: Counter[str] = field(default_factory=Counter)

    @property
    def done(self) -> int:
        """Number of files that this run has done."""
        return sum(self.ends.values())

    @property
    def is_nothing(self) -> bool:
        """Whether there was nothing to do in any file, now or before."""
        return {*self.ends, *self.ends_before} - {ends.UNCHANGED} == {ends.NOTHING}

    @property
    def failed(self) -> int:
        """Number of files of this run that gave no rows for a reason other than that there is nothing to do."""
        good = (ends.OK, ends.NOTHING, ends.UNCHANGED)
        return sum(number for status, number in self.ends.items() if status not in good)


def run_cohort(
    work: RunSettings,
    files: Sequence[Located],
    results: Results,
    where: RunPlace,
    progress: Callable[[RunSummary], None],
) -> RunSummary:
    """Do what is not done yet, and write its rows.

    Args:
        work: what to do with each file.
        files: the cohort.
        results: the tables.
        where: where the tasks run.
        progress: called after each file.

    Raises Unavailable without Dask or its scheduler, GatewayError if the tables cannot be written.
    """
    with results.locked():
        summary = RunSummary(len(files))
        known = results.known(work.verb, (each.shown for each in files))
        todo: list[KnownFile] = []
        for each in files:
            row = known.get(each.shown)
            if row and row["version"] == __version__ and row["settings"] == work.text and row["status"] in ends.FINAL:
                if row["mark"] == each.mark and each.mark:
                    summary.before += 1
                    summary.ends_before[row["status"]] += 1
                    continue
                todo.append(KnownFile(each, row["content"] or ""))
            else:
                todo.append(KnownFile(each, ""))
        progress(summary)
        if todo:
            _do(work, todo, known, results, where, summary, progress)
        results.compact()
    return summary


def _do(
    work: RunSettings,
    todo: Sequence[KnownFile],
    known: Mapping[str, Row],
    results: Results,
    where: RunPlace,
    summary: RunSummary,
    progress: Callable[[RunSummary], None],
) -> None:
    clock = SystemClock()
    provenance = {"verb": work.verb, "settings": work.text, "igtl_gateway_version": __version__}
    rows: dict[str, list[Row]] = {}
    waiting, since_ns = 0, clock.monotonic_ns()

    def flush() -> None:
        nonlocal waiting, since_ns
        if rows:
            results.add(rows, provenance)
        rows.clear()
        waiting, since_ns = 0, clock.monotonic_ns()

    try:
        with closing(_replies(work, todo, where)) as replies:
            for (file, _, _), reply in replies:
                if reply["status"] == ends.UNCHANGED:
                    rows.setdefault("tasks", []).append(known[file.shown] | {"mark": file.mark})
                    summary.ends_before[known[file.shown]["status"]] += 1
                else:
                    _add(rows, work, file, reply)
                summary.ends[reply["status"]] += 1
                if reply.get("error"):
                    summary.reasons.setdefault(reply["status"], str(reply["error"]))
                summary.different += _is_different(reply)
                waiting += 1
                if waiting >= _FLUSH_FILES or clock.monotonic_ns() - since_ns > _FLUSH_S * NS_PER_S:
                    flush()
                progress(summary)
    finally:
        flush()


def replies_of(work: RunSettings, todo: Sequence[KnownFile], where: RunPlace) -> Iterator[tuple[KnownFile, Reply]]:
    """Yield tasks with their replies, as they end, for a verb without tables.  Raises Unavailable."""
    with closing(_replies(work, todo, where)) as replies:
        yield from replies


def _add(rows: dict[str, list[Row]], work: RunSettings, file: Located, reply: Mapping[str, Any]) -> None:
    content = reply.get("content") or ""
    name = {"task": digest(file.shown, work.verb, work.text, __version__, content or file.mark), "file": file.shown}
    names = ("status", "error", "requests", "bytes_read", "seconds")
    task = {each: reply.get(each) for each in names} | {"verb": work.verb, "bytes": file.size, "mark": file.mark}
    for named in (file.name, file.shown):  # a column of its own has it
        task["error"] = (task["error"] or "").removeprefix(f"{named}: ")
    task |= {"content": content, "settings": work.text, "version": __version__}
    rows.setdefault("tasks", []).append(name | task)
    for table, found in reply.get("rows", {}).items():
        rows.setdefault(table, []).extend(name | row for row in found)


def _is_different(reply: Mapping[str, Any]) -> bool:
    rows = reply.get("rows", {})
    return (
        any(not row["good"] for row in rows.get("verifications", ()))
        or any(row["severity"] == "error" for row in rows.get("findings", ()))
        or any(row["verdict"] == ends.UNREADABLE for row in rows.get("lags", ()))
    )


def _replies(
    work: RunSettings, todo: Sequence[KnownFile], where: RunPlace
) -> Generator[tuple[KnownFile, Reply], None, None]:
    """Yield each file with its reply, as they end."""
    with (
        cluster(where)
        if where.scheduler
        else _here(where.workers if any(is_long(work, each) for each in todo) else min(where.workers, len(todo))) as do
    ):
        again = []
        whole = []
        for item in todo:
            is_cut = is_long(work, item) and (where.scheduler or len(todo) < where.workers)
            reply = in_segments(work, item, do) if is_cut else None
            if reply is None:
                whole.append(item)
            else:
                yield item, reply
        for item, reply in do(work, whole):
            if reply["status"] == ends.KILLED:
                again.append(item)
            else:
                yield item, reply
        # A worker that dies takes the blame for all that it had, and a program may be killed because the others took
        # the memory: each alone, only the guilty one fails again.
        for item in again:
            yield from do(work, [item])


@contextmanager
def _here(workers: int) -> Iterator[Runner]:
    """Context manager: threads of this process, of which each keeps a program of its own."""
    pool = ThreadPoolExecutor(workers, thread_name_prefix="igtl-cohort")

    def do(work: RunSettings, todo: Sequence[KnownFile]) -> Iterator[tuple[KnownFile, Reply]]:
        futures = {
            pool.submit(programs.run_task, job_of(work, item), work.memory, work.timeout_s): item for item in todo
        }
        for future in as_completed(list(futures)):
            item, error = futures.pop(future), future.exception()  # no reply is kept
            yield item, failed(error) if error else future.result()

    with Programs() as programs:
        try:
            yield do
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    pool.shutdown()  # soon: the programs have ended
