"""Which commit changed the outputs: git's own bisect, with the verdict of a re-simulation.

The search runs in a temporary clone that shares the objects of the user's repository: its working tree, index, refs
and bisect state are not touched, and everything is gone with the clone, also after Ctrl-C.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from igtl_gateway.addon import ConfigError, Unavailable
from igtl_gateway.addon.checking import EXACT, Tolerance
from igtl_gateway.addon.processes import KILL, Child, end_session
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addon.writing import make_folder
from igtl_gateway.addons.resim.engine import Program, ResimOptions, run
from igtl_gateway.addons.resim.verdict import Verdict, compare

GOOD, BAD, SKIP = "good", "bad", "skip"
_FIRST_BAD, _POSSIBLE = "# first bad commit: [", "# possible first bad commit: ["


@dataclass(frozen=True, slots=True)
class Commit:
    """A commit: its hash, the short one, its author, its day and its subject."""

    sha: str
    short: str
    author: str
    day: str
    subject: str


@dataclass(frozen=True, slots=True)
class Step:
    """A commit that was tried.

    Attributes:
        commit: the commit.
        mark: "good", "bad" or "skip".
        text: why.
        verdict: on its outputs, with those of GOOD as baseline; None if it was not built.
    """

    commit: Commit
    mark: str
    text: str
    verdict: Verdict | None = None


@dataclass(slots=True)
class Bisection:
    """The result.

    Attributes:
        steps: the commits that were tried, in order: GOOD and BAD first.
        found: the first commit whose outputs differ; None if several are possible, or if BAD is equal.
        possible: if commits that do not build stand before it: all that it could be.
    """

    steps: list[Step] = field(default_factory=list)
    found: Step | None = None
    possible: list[Commit] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0: BAD is equal to GOOD; 1: the commit is found; 2: it is one of several."""
        return 1 if self.found else 2 if self.possible else 0

    def lines(self) -> list[str]:
        """The result for a person."""
        if self.found:
            commit = self.found.commit
            return [
                f"FIRST CHANGED by {commit.short}: {commit.subject} ({commit.author}, {commit.day})",
                f"  {self.found.text}",
            ]
        if self.possible:
            commits = [
                f"  {commit.short}  {commit.subject} ({commit.author}, {commit.day})" for commit in self.possible
            ]
            return [f"NOT UNIQUE: one of these {counted(len(commits), 'commit')} changed the outputs first", *commits]
        ends = " and ".join(step.commit.short for step in self.steps)
        return [f"equal: {ends} have the same outputs, or the programs are not those of the checkout"]


def bisection_facts(result: Bisection) -> dict[str, object]:
    """The result as JSON."""
    return {
        "verdict": result.lines()[0],
        "exit_code": result.exit_code,
        "found": asdict(result.found.commit) if result.found else None,
        "possible": [asdict(commit) for commit in result.possible],
        "steps": [{"commit": asdict(step.commit), "mark": step.mark, "text": step.text} for step in result.steps],
    }


def bisect(
    span: str,
    build: str,
    recording: Path,
    programs: Sequence[Program],
    options: ResimOptions,
    *,
    tolerance: Tolerance = EXACT,
    on_step: Callable[[Step], None] = lambda step: None,
) -> Bisection:
    """Find the first commit whose programs have other outputs than those of GOOD.

    Commits that do not build are skipped.  So are those whose programs end or hang, unless those of BAD do, too.

    Args:
        span: ``GOOD..BAD``, of the repository that the current folder is in.
        build: command of the shell that builds a checkout, run where the current folder is in it; "": nothing to do.
        recording: what drives the programs.
        programs: they run where the current folder is in the checkout.
        options: how to run.
        tolerance: what may differ.
        on_step: called after each commit.

    Raises:
        ConfigError: not a repository, no such commits, a program of the working tree, or GOOD cannot be the baseline.
        Unavailable: git is not installed.
    """
    recording = recording.resolve()
    with _clone() as clone:
        good, bad = clone.ends(span)
        placed = [clone.placed(program) for program in programs]
        result = Bisection()

        def note(step: Step) -> Step:
            result.steps.append(step)
            on_step(step)
            return step

        baseline = clone.outputs / "baseline.mcap"

        def tried(commit: Commit, *, is_fault_bad: bool) -> Step:
            clone.checkout(commit)
            if error := clone.build(build):
                return Step(commit, SKIP, f"does not build: {error}")
            try:
                runs = run(recording, placed, options, clone.outputs)
            except ConfigError as error:  # a program that this commit does not have
                return Step(commit, BAD if is_fault_bad else SKIP, str(error))
            reference = baseline if baseline.exists() else None
            verdict = compare(runs, reference=reference, tolerance=tolerance, outputs=options.outputs)
            if verdict.fault:
                return Step(commit, BAD if is_fault_bad else SKIP, verdict.line(), verdict)
            return Step(commit, BAD if verdict.exit_code else GOOD, verdict.line(), verdict)

        first = note(tried(good, is_fault_bad=False))
        if first.mark != GOOD:
            raise ConfigError(f"{good.short} cannot be the baseline: {first.text}")
        clone.outputs.joinpath("run-1.mcap").rename(baseline)
        last = note(tried(bad, is_fault_bad=True))
        if last.mark == SKIP:
            raise ConfigError(f"{bad.short} cannot be judged: {last.text}")
        if last.mark == GOOD:
            return result
        is_fault_bad = last.verdict is None or bool(last.verdict.fault)
        clone.git("bisect", "start", bad.sha, good.sha)
        while not (ends := clone.found()):
            commit = clone.commit("HEAD")
            clone.mark(note(tried(commit, is_fault_bad=is_fault_bad)))
        if len(ends) == 1:
            result.found = next(step for step in result.steps if step.commit.sha == ends[0])
        else:
            result.possible = [clone.commit(sha) for sha in ends]
        return result


@contextmanager
def _clone() -> Iterator[_Clone]:
    """A clone of the repository that the current folder is in, as long as the with block runs."""
    top = Path(_git(None, "rev-parse", "--show-toplevel"))
    with tempfile.TemporaryDirectory(prefix="igtl-bisect-", ignore_cleanup_errors=True) as folder:
        place = Path(folder) / "checkout"
        _git(None, "clone", "--quiet", "--shared", "--no-checkout", str(top), str(place))
        outputs = Path(folder) / "outputs"
        make_folder(outputs)
        yield _Clone(top, place, outputs)


class _Clone:
    """A clone.

    Args:
        top: the user's working tree.
        place: that of the clone.
        outputs: an empty folder.
    """

    def __init__(self, top: Path, place: Path, outputs: Path) -> None:
        self._top, self._place, self.outputs = top, place, outputs
        self._within = Path.cwd().resolve().relative_to(top.resolve())

    def git(self, *words: str) -> str:
        return _git(self._place, *words)

    def ends(self, span: str) -> tuple[Commit, Commit]:
        """The commits of ``GOOD..BAD``.  Raises ConfigError."""
        good, dots, bad = span.partition("..")
        if not dots or not good or not bad or bad.startswith("."):
            raise ConfigError(f"--bisect: found {span!r}, expected GOOD..BAD")
        # the names are those of the user's repository; the clone has its objects
        shas = [_git(self._top, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}",
                     wrong=f"--bisect: found no commit {name!r}") for name in (good, bad)]  # fmt: skip
        if _git(self._top, "merge-base", *shas, wrong=f"--bisect: {good} and {bad} have no common history") != shas[0]:
            raise ConfigError(f"--bisect: found {good}, which is not an ancestor of {bad}, expected one that is")
        if shas[0] == shas[1]:
            raise ConfigError(f"--bisect: found {good} and {bad}, which are one commit, expected two")
        return self.commit(shas[0]), self.commit(shas[1])

    def commit(self, sha: str) -> Commit:
        return Commit(*self.git("show", "--no-patch", "--format=%H%x00%h%x00%an%x00%as%x00%s", sha).split("\0"))

    def checkout(self, commit: Commit) -> None:
        """Make the tree that of a commit; what a build has left beside it stays, as in any bisect."""
        self.git("checkout", "--quiet", "--force", "--detach", commit.sha)

    def placed(self, program: Program) -> Program:
        """A program that runs in the clone.  Raises ConfigError if it is a file of the user's working tree."""
        for word in program.command:
            path = Path(word)
            if path.is_absolute() and path.is_relative_to(self._top) and self._has(path):
                found = path.relative_to(self._top)
                raise ConfigError(
                    f"--bisect: found {word}, a file of the working tree, expected {found} as in a checkout"
                )
        folder = (program.folder or Path.cwd()).resolve()
        if folder.is_relative_to(self._top.resolve()):
            folder = self._place / folder.relative_to(self._top.resolve())
        return replace(program, folder=folder, env={**_moved(self._top, self._place), **program.env})

    def _has(self, path: Path) -> bool:
        return bool(_git(self._top, "ls-files", "--", str(path)))

    def build(self, command: str) -> str:
        """Build the checkout; the last line of the output if that fails."""
        if not command:
            return ""
        lines: deque[str] = deque(maxlen=1)
        shell = ("env", "-C", str(self._place / self._within), "sh", "-c", command)
        env = {**_environment(), **_moved(self._top, self._place)}
        child = Child("build", shell, on_line=lines.append, on_error_line=lines.append, env=env, death_signal=KILL)
        try:
            with child:
                code = child.wait()
        finally:
            end_session(child.pid)
        return "" if code == 0 else (lines[0].strip() if lines else f"exit code {code}")

    def mark(self, step: Step) -> None:
        """Report the verdict on the commit that is checked out; git checks out the next one."""
        self.git("reset", "--quiet", "--hard")  # a build may change files of the commit
        code, out = _run(self._place, "bisect", step.mark)
        if code not in (0, 2):  # 2: only skipped commits are left
            raise ConfigError(f"git bisect {step.mark}: {out}")

    def found(self) -> list[str]:
        """The first bad commit, or all that it can be; none while the search goes on."""
        log = self.git("bisect", "log").splitlines()
        for begin in (_FIRST_BAD, _POSSIBLE):
            shas = [line.removeprefix(begin).partition("]")[0] for line in log if line.startswith(begin)]
            if shas:
                return shas
        return []


def _moved(top: Path, place: Path) -> dict[str, str]:
    """Variables of the environment for programs of the clone.

    Modules of the checkout instead of those of the working tree, and none that an earlier commit has compiled: a file
    of the same size and second counts as unchanged.
    """
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    moved = [
        str(place / Path(each).relative_to(top)) if each and Path(each).is_relative_to(top) else each for each in paths
    ]
    return {"PYTHONPATH": os.pathsep.join(moved), "PYTHONDONTWRITEBYTECODE": "1"}


def _environment() -> dict[str, str]:
    """Our own, without the variables by which a git hook directs git to its repository."""
    return {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}


def _run(folder: Path | None, *words: str) -> tuple[int, str]:
    """Run git: exit code, and its output or its first line of complaint."""
    command = ["git", "-c", f"core.hooksPath={os.devnull}", "-c", "advice.detachedHead=false", *words]
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors="replace", check=False, env=_environment()
        )
    except FileNotFoundError:
        raise Unavailable("--bisect: found no git, expected it on the path") from None
    error = next((line for line in done.stderr.splitlines() if line.strip()), "")
    return done.returncode, done.stdout.strip() if done.returncode == 0 else error


def _git(folder: Path | None, *words: str, wrong: str = "") -> str:
    """Run git; its output.  Raises ConfigError with ``wrong``, or what git reports."""
    code, out = _run(folder, *words)
    if code:
        raise ConfigError(wrong or f"--bisect: git {words[0]}: {out or f'exit code {code}'}")
    return out
