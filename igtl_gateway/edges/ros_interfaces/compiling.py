"""Compiles packages into a folder of the cache: whole or not at all, one process at a time, with progress.

A package is compiled in a work folder beside its place and renamed at the end, so a package that is there is complete.
The work is done by a process of its own (:mod:`.build`), in a session of its own.  Ctrl-C ends it and removes the work
folder; if this process is killed, the other one does that by itself.  What a power failure leaves, the next start
removes.

Many processes can start for the first time at once: one compiles under a lock, and the others wait for it.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from igtl_gateway.base.child import Child
from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.quantities import seconds_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems import files
from igtl_gateway.base.systems.processes import end_session, usable_cpus
from igtl_gateway.base.systems.signals import endings_noted
from igtl_gateway.base.versions import add_note, python_command
from igtl_gateway.convert.interfaces import definition_folder
from igtl_gateway.edges.ros_interfaces.progress import Progress, write_line

BUILD = Path(__file__).with_name("build.py")
#: Package → seconds of CPU time that it takes; measured.
COSTS = {"igtl_msgs": 15.0, "rosbag2_interfaces": 8.0, "crtk_msgs": 3.0, "tf2_msgs": 3.0, "foxglove_msgs": 3.0}
_USUAL_COST = 3.0
#: What the work folders of two packages at once take of the disk, with their results; measured: 14 MB.
ROOM = 25_000_000
INTERRUPTED = "Interrupted: nothing half-made is left; the next start compiles what is missing."
#: Names in a folder of the cache.  `_OLD_WORK`: of version 0.1.
LOCK, _WORK, _OLD_WORK = "lock", "work-", "*.work"
_LOOK_S = 0.1
_PROGRAM_LENGTH = 40
_WAIT_EACH_S = 30
#: Tries to remove a work folder, in which a compiler that is being killed may make a last file.
_TRIES = 20
#: What a program calls a full disk: ENOSPC and EDQUOT.
_FULL = ("No space left on device", "Disk quota exceeded")

Ended = Callable[[], bool]

_ONE_AT_A_TIME = threading.RLock()
_clock = SystemClock()


def compile_packages(places: Mapping[str, Path], folders: Sequence[Path], prefix: Path) -> Path:
    """Compile packages into the first folder that can take them, and return it.

    Args:
        places: package → its place relative to a folder.
        folders: for compiled packages, the preferred one first.
        prefix: folder with ``share``, ``include`` and ``lib`` of the ROS wheels.

    Raises:
        ImportError: a package cannot be compiled; the text is one sentence with the reason.
        KeyboardInterrupt: it was interrupted; packages that were complete stay, nothing else does.
    """
    first = next(iter(places))
    what = first if len(places) == 1 else "ROS message packages"
    _check_compiler(first)
    with _ONE_AT_A_TIME, endings_noted() as ended:
        root = _folder_with_room(what, folders)
        try:
            with _locked(root, ended):
                for left in (*root.glob(f"{_WORK}*"), *root.glob(_OLD_WORK)):
                    _remove(left)  # of a process that was killed: this one has the lock
                missing = {package: place for package, place in places.items() if not (root / place).is_dir()}
                if missing:
                    _compile_all(missing, root, prefix, ended)
        except OSError as error:
            raise _failure(what, root, error.strerror or str(error)) from error
    return root


def _compile_all(places: Mapping[str, Path], root: Path, prefix: Path, ended: Ended) -> None:
    """Compile packages, as many at once as there are processors, the longest first."""
    at_once = usable_cpus()
    waiting = sorted(places, key=lambda package: -COSTS.get(package, _USUAL_COST))
    progress = Progress({package: COSTS.get(package, _USUAL_COST) for package in waiting}, at_once, _clock)
    jobs: list[_Job] = []
    try:
        while waiting or jobs:
            while waiting and len(jobs) < at_once:
                package = waiting.pop(0)
                jobs.append(_Job(package, prefix, Path(tempfile.mkdtemp(prefix=_WORK, dir=root))))
            threading.Event().wait(_LOOK_S)
            if ended():
                raise KeyboardInterrupt
            for job in list(jobs):
                if job.has_finished():
                    place = root / places[job.package]
                    place.parent.mkdir(exist_ok=True)
                    job.result.rename(place)
                    files.sync_folder(place.parent)
                    jobs.remove(job)
                    job.close()
                progress.show(job.package, job.share, job.under_way)
    except KeyboardInterrupt:
        progress.close()
        write_line(INTERRUPTED)
        raise
    except BaseException:
        progress.close()
        raise
    finally:
        for job in jobs:
            job.close()
    progress.close()
    write_line(f"ROS message packages: compiled in {seconds_text(progress.elapsed_s)}.")


def compile_package(package: str, prefix: Path, work: Path, libraries: str = "") -> None:
    """Compile to ``work/result/PACKAGE``, for :mod:`.__main__`; ``libraries``: as in :mod:`.build`.

    Raises ImportError as in :func:`compile_packages`; a note has the output of the process.
    """
    job = _Job(package, prefix, work, libraries)
    while not job.has_finished():
        threading.Event().wait(_LOOK_S)


class _Job:
    """The compilation of a package, in a process of its own: the generators print and have global state.

    Args:
        package: name of the package.
        prefix: folder with ``share``, ``include`` and ``lib`` of the wheels.
        work: an empty folder for all files, which `close` removes.
        libraries: as in :mod:`.build`.

    Attributes:
        share, under_way: what of the work is done, and is being done, 0 to 1.
        result: the compiled package, once the job has finished.
    """

    def __init__(self, package: str, prefix: Path, work: Path, libraries: str = "") -> None:
        self.package = package
        self.share = self.under_way = 0.0
        self.result = work / "result" / package
        self._work = work
        command = [*python_command(BUILD), package, str(definition_folder(package)), str(prefix), str(work)]
        if libraries:
            command.append(libraries)
        self._child = Child(
            f"compile-{package}",
            command,
            on_line=self._take,
            # compilers leave temporary files when they are killed
            env={**os.environ, "TMPDIR": str(work)},
            death_signal=signal.SIGTERM,
        )

    def _take(self, line: str) -> None:
        with suppress(ValueError):
            self.share, self.under_way = map(float, line.split())

    def has_finished(self) -> bool:
        """Whether the package is compiled.  Raises ImportError if it cannot be."""
        if self._child.is_running:
            return False
        code = self._child.wait()
        if code:
            lines = self._child.error_lines()
            raise _failure(self.package, self._work.parent, _reason(lines) or f"exit code {code}", "\n".join(lines))
        self.share, self.under_way = 1.0, 0.0
        return True

    def close(self) -> None:
        """End it with all that it has started, and remove its folder."""
        end_session(self._child.pid)
        self._child.kill()
        _remove(self._work)


def _reason(lines: Sequence[str]) -> str:
    """The line of a failed compilation that names the cause."""
    for line in lines:
        if found := next((text for text in _FULL if text in line), ""):
            return found
    lines = [line.strip() for line in lines if line.strip()]
    return next((line for line in lines if "error: " in line), lines[-1] if lines else "")


def _failure(what: str, root: Path, reason: str, output: str = "") -> ImportError:
    if reason in _FULL:
        free = _free_text(root)
        reason = f"the disk of {root} is full: found {free} free, expected {size_text(ROOM)}"
    error = ImportError(f"{what} could not be compiled: {reason}")
    if output:
        add_note(error, output)
    return error


def _free_text(folder: Path) -> str:
    return size_text(shutil.disk_usage(folder).free)


def _check_compiler(package: str) -> None:
    python = f"python{sys.version_info.major}.{sys.version_info.minor}"
    missing = [(name, "g++") for name in ("gcc", "g++") if not shutil.which(name)]
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        missing.append(("Python.h", f"{python}-dev"))
    if missing:
        names = " and ".join(name for name, _ in missing)
        advice = " ".join(dict.fromkeys(debian for _, debian in missing))
        raise ImportError(
            f"{package} must be compiled once, but there is no {names} (Debian and Ubuntu: apt install {advice})",
            name=package,
        )


def _folder_with_room(what: str, folders: Sequence[Path]) -> Path:
    """Return the first folder that is writable and has room.  Raises ImportError if none is."""
    found = []
    for folder in folders:
        if not (problem := _problem_of(folder)):
            return folder
        found.append(f"{folder} {problem}")
    raise ImportError(
        f"{what} must be compiled once: found {', and '.join(found)}; expected a folder to write to with "
        f"{size_text(ROOM)} free (XDG_CACHE_HOME=FOLDER names another)"
    )


def _problem_of(folder: Path) -> str:
    """Return why packages cannot be compiled in a folder, which is made; "" if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        Path(tempfile.mkdtemp(prefix=_WORK, dir=folder)).rmdir()
    except OSError as error:
        return f"not writable ({error.strerror})"
    if shutil.disk_usage(folder).free < ROOM:
        return f"with {_free_text(folder)} free"
    return ""


@contextmanager
def _locked(root: Path, ended: Ended) -> Iterator[None]:
    """Hold the lock of a folder, which names its owner; report for which process this one waits.

    The kernel releases the lock of a process that is killed.  Raises KeyboardInterrupt if ``ended`` returns true.
    """
    path = root / LOCK
    began_ns = tell_ns = _clock.monotonic_ns()
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            is_free = _try_lock(handle)
            if is_free and _is_at(path, handle):
                break
            owner = os.read(handle, 1 << 12)
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)
        if is_free:  # its owner has just removed it
            continue
        now_ns = _clock.monotonic_ns()
        if now_ns >= tell_ns:
            still = f" ({seconds_text((now_ns - began_ns) / NS_PER_S)} so far)" if tell_ns > began_ns else ""
            write_line(f"Waiting for {_owner_text(owner)}: it compiles ROS messages{still}.")
            tell_ns = now_ns + _WAIT_EACH_S * NS_PER_S
        threading.Event().wait(_LOOK_S)
        if ended():
            write_line(INTERRUPTED)
            raise KeyboardInterrupt
    try:
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps({"pid": os.getpid(), "program": _program()}).encode())
        yield
    finally:
        files.remove_locked(path, handle)


def _try_lock(handle: int) -> bool:
    try:
        files.lock(handle)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks: work folders have names of their own, and a rename is whole
    return True


def _is_at(path: Path, handle: int) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(handle))
    except OSError:
        return False


def _program() -> str:
    """The program of this process, with its verb."""
    verb = [word for word in sys.argv[1:2] if word.isalpha()]
    return " ".join([Path(sys.argv[0]).name, *verb])[:_PROGRAM_LENGTH]


def _owner_text(content: bytes) -> str:
    try:
        owner = json.loads(content)
        return f"process {int(owner['pid'])} ({owner['program']})"
    except (ValueError, TypeError, KeyError):
        return "another process"


def _remove(folder: Path) -> None:
    for _ in range(_TRIES):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return
        threading.Event().wait(_LOOK_S)
