"""Retention: deletes closed recordings of a folder by age and by total size, the oldest first.

What is never deleted: an open recording; with sealing, one that is not sealed to its end; with upload, one that the
store has not confirmed; whatever is not a recording, or is a link; a part while an earlier one is kept.  A recording
is deleted under the lock of its writer, and only if it is the file that was looked at.

The age of a recording is the time since its file last changed, which is when it was closed.  The clock decides only as
far as it is credible, see :class:`Retention`: a wrong clock must not delete everything.

A session that runs must not delete all that is older, however fast it grows: it takes no more than half of the size
from the recordings of others.  Beyond that, its own oldest parts give way.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.quantities import count_text, duration_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.files import OpenFolder, lock
from igtl_gateway.config.notations import RetentionRule
from igtl_gateway.record.retention.retention_log import RetentionLog
from igtl_gateway.record.retention.side_files import update_side_file
from igtl_gateway.record.retention.stored import RecordingFolder, StoredFiles, StoredRecording, identity_of
from igtl_gateway.record.retention.upload_state import remove_finished

#: No clock of a running gateway shows an earlier time, and no recording has one: 2025-01-01 and 2015-01-01, UTC ns.
_EARLIEST_NOW_NS = 1_735_689_600 * NS_PER_S
_EARLIEST_NS = 1_420_070_400 * NS_PER_S
#: Most that the clock may gain on the monotonic clock while the gateway runs.
_MOST_GAIN_NS = 300 * NS_PER_S
#: Time for which ages do not count after the clock has jumped ahead.
_REST_NS = 3600 * NS_PER_S

#: Returns whether a recording is one of a session that runs.
IsRunning = Callable[[StoredRecording], bool]

#: Returns why a recording must be kept, or "".
ReasonToKeep = Callable[[StoredRecording], str]


@dataclass(frozen=True, slots=True)
class Choice:
    """A recording that the rule selects.

    Attributes:
        recording: the recording.
        reason: why it is selected, for people.
        kept: why it is not deleted all the same; "": it is.
    """

    recording: StoredRecording
    reason: str
    kept: str = ""


@dataclass(frozen=True, slots=True)
class RetentionReport:
    """The result of a pass.

    Attributes:
        deleted: recordings that were deleted, or would be.
        kept: recordings that the rule selects and something protects.
        bytes_left: size of all recordings after it.
        clock: why ages did not count, or "".
        problem: what prevented the pass, or "".
        complete: whether all files of the folder were looked at.
        is_above: all together are larger than the rule permits, because of the session that runs.
    """

    deleted: list[Choice] = field(default_factory=list)
    kept: list[Choice] = field(default_factory=list)
    bytes_left: int = 0
    clock: str = ""
    problem: str = ""
    complete: bool = True
    is_above: bool = False


def choose(
    found: StoredFiles,
    rule: RetentionRule,
    now_ns: int | None,
    hindrance: ReasonToKeep,
    is_running: IsRunning = lambda _recording: False,
) -> list[Choice]:
    """Return the recordings that a rule selects, the oldest first.

    Args:
        found: what is in the folder.
        rule: the rule.
        now_ns: UTC ns; None: ages do not count.
        hindrance: returns why a recording must be kept.
        is_running: whether a recording is one of a session that runs; the parts beside an open one are, too.
    """
    running = {each for each in found.closed if each.parent in found.running or is_running(each)}
    own = found.running_bytes + sum(each.size for each in running)
    others = found.open_bytes - found.running_bytes + sum(each.size for each in found.closed if each not in running)
    most_others = rule.size - min(own, rule.size // 2)
    choices: dict[StoredRecording, Choice] = {}
    broken: set[Path] = set()  # folders in which a part is kept: the parts behind it are kept, too
    by_age = _by_age(found.closed, now_ns)
    # the session that runs has all that the others leave, so these give way first
    for time_ns, each in sorted(by_age, key=lambda row: row[1] in running):
        reason = ""
        if rule.age_s and now_ns is not None and time_ns and now_ns - time_ns > rule.age_s * NS_PER_S:
            reason = f"closed {duration_text(now_ns - time_ns)} ago"
        elif rule.size and (own > rule.size - min(others, most_others) if each in running else others > most_others):
            reason = f"all are {count_text(own + others, 'byte')}"
        kept = hindrance(each) if reason else ""
        if reason and not kept and each.part >= 0 and each.parent in broken:
            kept = "an earlier part is kept"
        if each.part >= 0 and (kept or not reason):
            broken.add(each.parent)
        if reason:
            choices[each] = Choice(each, reason, kept)
            if each in running:
                own -= 0 if kept else each.size
            else:
                others -= 0 if kept else each.size
    return [choices[each] for _, each in by_age if each in choices]


def _by_age(recordings: Iterable[StoredRecording], now_ns: int | None) -> list[tuple[int, StoredRecording]]:
    """Return time and recording, the oldest first; a part is not older than the parts before it.

    The order is that of the files.  The time is 0 where neither the file nor its last entry has a credible one.
    """
    latest: dict[Path, tuple[int, int]] = {}
    rows = []
    for each in sorted(recordings, key=lambda one: (one.name.rpartition("/")[0], one.part, one.name)):
        order_ns = each.modified_ns
        time_ns = next((time for time in (order_ns, each.end_ns) if _is_credible(time, now_ns)), 0)
        if each.part >= 0:
            before = latest.get(each.parent, (0, 0))
            order_ns, time_ns = latest[each.parent] = max(order_ns, before[0]), max(time_ns, before[1])
        rows.append((order_ns, time_ns, each))
    rows.sort(key=lambda row: row[0])
    return [(time_ns, each) for _, time_ns, each in rows]


def _is_credible(time_ns: int, now_ns: int | None) -> bool:
    return _EARLIEST_NS <= time_ns and (now_ns is None or time_ns <= now_ns)


class Retention:
    """Applies a rule to a folder, pass by pass.

    Ages do not count

    * while the clock is before 2025;
    * for an hour after the clock has jumped: if it is further ahead of the last pass than the whole age, so that
      everything would be too old, or has gained more than five minutes on the monotonic clock.

    A recording whose time is before 2015 or in the future is not deleted by age.

    Args:
        folder: the folder.
        rule: the rule.
        clock: UTC decides about ages; the monotonic clock finds jumps.
        hindrance: returns why a recording must be kept.
        trust_clock: ages count also after a jump: the user confirmed it.
        is_live: whether a recorder of this process writes into a folder, and its side file.
        is_running: whether a recording is one of the session that this process records.
    """

    def __init__(
        self,
        folder: Path,
        rule: RetentionRule,
        clock: Clock,
        hindrance: ReasonToKeep = lambda _recording: "",
        *,
        trust_clock: bool = False,
        is_live: Callable[[Path], bool] = lambda _folder: False,
        is_running: IsRunning = lambda _recording: False,
    ) -> None:
        self._folder = RecordingFolder(folder)
        self._rule = rule
        self._clock = clock
        self._hindrance = hindrance
        self._trusts_clock = trust_clock
        self._is_live, self._is_running = is_live, is_running
        self._log = RetentionLog(folder)
        self._offset_ns: int | None = None  # of UTC to the monotonic clock
        self._rest_until_ns = 0  # on the monotonic clock
        self._noted_rule = False

    def preview(self) -> RetentionReport:
        """Return what a pass would delete; nothing changes."""
        return self._pass(dry=True)

    def apply(self) -> RetentionReport:
        """Delete what the rule selects.  Errors are in the report."""
        return self._pass(dry=False)

    def _pass(self, *, dry: bool) -> RetentionReport:
        now_ns = self._clock.utc_ns()
        why = self._clock_problem(now_ns) if self._rule.age_s else ""
        try:
            found = self._folder.search()
        except OSError as error:
            return RetentionReport(clock=why, problem=f"{self._folder.path}: {error.strerror}")
        choices = choose(found, self._rule, None if why else now_ns, self._hindrance, self._is_running)
        report = RetentionReport(clock=why, complete=found.complete, kept=[each for each in choices if each.kept])
        wanted = [each for each in choices if not each.kept]
        total = found.open_bytes + sum(each.size for each in found.closed)
        if dry:
            return replace(report, deleted=wanted, bytes_left=total - sum(each.recording.size for each in wanted))
        mark_ns = self._log.last_pass_ns() if why else now_ns  # a jump is found again after a restart
        problem = self._begin_log(now_ns)
        broken: set[Path] = set()
        for each in wanted if not problem else []:
            recording = each.recording
            kept = "an earlier part is kept" if recording.part >= 0 and recording.parent in broken else ""
            if not kept:
                kept = self._delete(each, now_ns)
            if kept:
                broken.add(recording.parent)
                report.kept.append(replace(each, kept=kept))
            else:
                total -= recording.size
                report.deleted.append(each)
        for folder in sorted({each.recording.parent for each in report.deleted if each.recording.part >= 0}):
            if not self._is_live(folder):
                update_side_file(folder)
        gone = {each.recording.name for each in report.deleted}
        if gone:
            remove_finished(self._folder.path, {each.name for each in found.closed} - gone)
        with suppress(OSError):  # it was possible before
            self._log.mark(mark_ns or now_ns)
        is_above = bool(self._rule.size and total > self._rule.size and not report.kept and not problem)
        return replace(report, bytes_left=total, problem=problem, is_above=is_above)

    def _begin_log(self, now_ns: int) -> str:
        """State the rule once; return what prevents it."""
        try:
            if not self._noted_rule:
                self._log.add(now_ns, "rule", rule=self._rule.text)
                self._noted_rule = True
            self._log.check()
        except OSError as error:
            return f"{self._log.path}: {error.strerror}; without its log nothing is deleted"
        return ""

    def _clock_problem(self, now_ns: int) -> str:
        """Return why ages do not count now, or ""."""
        monotonic_ns = self._clock.monotonic_ns()
        offset_ns, before_ns = now_ns - monotonic_ns, self._offset_ns
        self._offset_ns = offset_ns
        if now_ns < _EARLIEST_NOW_NS:
            return "the clock is before 2025"
        if self._trusts_clock:
            return ""
        jump_ns = 0
        if before_ns is not None:
            gain_ns = offset_ns - before_ns
            jump_ns = gain_ns if gain_ns > _MOST_GAIN_NS else 0
        elif (last_ns := self._log.last_pass_ns()) and now_ns - last_ns > self._rule.age_s * NS_PER_S:
            jump_ns = now_ns - last_ns
        if jump_ns:
            self._rest_until_ns = monotonic_ns + _REST_NS
        if monotonic_ns < self._rest_until_ns:
            return (
                "the clock has jumped ahead of the last pass by more than the age, or by more than 5 min while running"
            )
        return ""

    def _delete(self, choice: Choice, now_ns: int) -> str:
        """Delete a recording; return why it is kept, or ""."""
        recording = choice.recording
        try:
            folder = OpenFolder(recording.parent)
        except OSError as error:
            return f"{error.strerror}"
        try:
            return self._delete_in(folder, choice, now_ns)
        except BlockingIOError:
            return "another process is recording to it"
        except OSError as error:
            with suppress(OSError):
                self._log.add(now_ns, "not deleted", file=recording.name, why=error.strerror)
            return f"{error.strerror}"
        finally:
            folder.close()

    def _delete_in(self, folder: OpenFolder, choice: Choice, now_ns: int) -> str:
        """As `_delete`; raises BlockingIOError if it is being written, OSError."""
        recording, name = choice.recording, choice.recording.path.name
        file = folder.open(name)
        try:
            try:
                lock(file)
            except BlockingIOError:
                raise
            except OSError:
                pass  # a file system without locks
            if not identity_of(os.fstat(file)) == identity_of(folder.stat(name)) == recording.identity:
                return "it has just changed"
            facts = {"bytes": recording.size, "ended_ns": recording.end_ns, "closed_ns": recording.modified_ns}
            self._log.add(now_ns, "delete", file=recording.name, reason=choice.reason, **facts)
            removed, file = file, -1
            folder.remove_locked(name, removed)
        finally:
            if file >= 0:
                os.close(file)
        return ""
