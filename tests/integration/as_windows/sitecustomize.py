"""A Python that lacks what Windows lacks, and refuses what Windows refuses: it is on PYTHONPATH of such a test.

What is imitated is listed in ``docs/how-to/systems.md``.  The standard library stays that of this system: it is
imported first.  What follows is for all that is imported later.
"""

from __future__ import annotations

import asyncio
import concurrent.futures.thread
import ctypes
import errno
import http.client
import http.server
import importlib
import logging.handlers
import mmap
import multiprocessing.connection
import multiprocessing.util
import os
import platform
import re
import select
import selectors
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import types
import uuid
import webbrowser
import zipfile
from contextlib import suppress
from typing import Any

TEMPORARY = os.path.realpath(tempfile.gettempdir()) + os.sep
LOADED: list[types.ModuleType] = [
    asyncio,
    concurrent.futures.thread,
    http.client,
    http.server,
    logging.handlers,
    multiprocessing.connection,
]
LOADED += [multiprocessing.util, platform, shutil, ssl, sysconfig, tempfile, uuid, webbrowser, zipfile]
for name in ("numpy", "zenoh", "zenoh.ext"):  # they ask which system this is when they are imported
    with suppress(ImportError):
        importlib.import_module(name)

MODULES = "fcntl grp posix pty pwd resource syslog termios tty _posixshmem rclpy"
NATIVE = ("native._express", "native._passage", "native._queue", "native._chunk", "native._columns", "native._figures")

ABSENT: dict[types.ModuleType, str] = {
    os: "O_ASYNC O_CLOEXEC O_DIRECTORY O_DSYNC O_NOATIME O_NOCTTY O_NOFOLLOW O_NONBLOCK O_PATH O_SYNC O_TMPFILE "
    "RTLD_NOW chown chroot eventfd fchmod fchown fdatasync fork forkpty getegid geteuid getgid getgroups getloadavg "
    "getpgid getpgrp getsid getuid killpg lchown lockf major makedev memfd_create minor mkfifo mknod nice openpty "
    "pipe2 posix_fadvise posix_fallocate posix_spawn pread preadv pwrite pwritev readv register_at_fork "
    "sched_getaffinity sched_param sched_setaffinity sched_setscheduler sched_yield SCHED_FIFO sendfile setpgid "
    "setsid splice statvfs sync sysconf tcgetpgrp tcsetpgrp ttyname uname wait wait3 wait4 writev",
    signal: "SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGIO SIGKILL SIGPIPE SIGPROF SIGQUIT SIGSTOP SIGTSTP SIGTTIN "
    "SIGTTOU SIGUSR1 SIGUSR2 SIGWINCH alarm pause pthread_kill pthread_sigmask setitimer siginterrupt sigpending "
    "sigtimedwait sigwait sigwaitinfo",
    socket: "AF_UNIX CMSG_LEN CMSG_SPACE SCM_RIGHTS SO_PEERCRED SO_REUSEPORT TCP_INFO recv_fds send_fds",
    select: "epoll poll EPOLLIN POLLIN POLLOUT",
    mmap: "MAP_ANON MAP_ANONYMOUS MAP_PRIVATE MAP_SHARED MADV_REMOVE PROT_READ PROT_WRITE",
    time: "CLOCK_BOOTTIME CLOCK_MONOTONIC CLOCK_REALTIME clock_gettime clock_gettime_ns pthread_getcpuclockid tzset",
}
#: Nanoseconds: the clocks of Windows advance in such steps before Python 3.13.
STEP_NS = 15_625_000

flock, LOCK_SH, LOCK_EX, LOCK_NB, LOCK_UN = (
    getattr(importlib.import_module("fcntl"), word) for word in ("flock", "LOCK_SH", "LOCK_EX", "LOCK_NB", "LOCK_UN")
)
statvfs = os.statvfs
time_ns, readlink, listdir, os_open = time.time_ns, os.readlink, os.listdir, os.open

#: What GetLastError returns.
last_errors = [0]


# ── what kernel32 and the C library do ─────────────────────────────────────────────────────────────────────────────


class Kernel:
    """The functions of kernel32.dll that the gateway calls, with ``flock`` of this system."""

    def __init__(self, name: str, use_last_error: bool = False) -> None:
        assert name == "kernel32"
        self.GetCurrentProcess = lambda: -1
        self.GetCurrentProcess.restype = None  # type: ignore[attr-defined]
        self.SetPriorityClass = lambda process, kind: 1

    @staticmethod
    def LockFileEx(file: Any, flags: int, reserved: int, low: int, high: int, place: Any) -> int:  # noqa: N802
        assert (reserved, low, high) == (0, 1, 0) and place._obj.offset_high == 1 << 30 and flags & 1
        try:
            flock(file.value, (LOCK_EX if flags & 2 else LOCK_SH) | LOCK_NB)
        except BlockingIOError:
            last_errors[0] = 33
            return 0
        return 1

    @staticmethod
    def UnlockFileEx(file: Any, reserved: int, low: int, high: int, place: Any) -> int:  # noqa: N802
        flock(file.value, LOCK_UN)
        return 1

    @staticmethod
    def GetSystemTimePreciseAsFileTime(found: Any) -> None:  # noqa: N802
        found._obj.value = time_ns() // 100 + 116_444_736_000_000_000


def tcp_pair(*_: Any) -> tuple[socket.socket, socket.socket]:
    """``socketpair`` of the standard library for Windows."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = socket.create_connection(server.getsockname())
        return server.accept()[0], one


def disk_usage(path: Any) -> types.SimpleNamespace:
    """``shutil.disk_usage``, which asks ``nt`` on Windows."""
    found = statvfs(path)
    return types.SimpleNamespace(free=found.f_bavail * found.f_frsize)


def no_attribute(it: object) -> None:
    raise AttributeError("Windows does not have it")


class Popen(subprocess.Popen):  # type: ignore[type-arg]
    """Refuses what Windows refuses."""

    def __init__(self, *args: Any, creationflags: int = 0, **more: Any) -> None:
        if refused := {"preexec_fn", "pass_fds", "start_new_session", "process_group", "umask"} & more.keys():
            raise ValueError(f"{sorted(refused)} not supported on Windows platforms")
        super().__init__(*args, **more)


# ── files ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def open_file(path: Any, flags: int, mode: int = 0o777, *, dir_fd: None = None) -> int:
    """``os.open``: files have no mode, and folders no descriptor."""
    if dir_fd is not None:
        raise NotImplementedError("dir_fd unavailable on this platform")
    return os_open(path, flags, 0o666)


def open_here(path: str) -> bool:
    """Return whether this process has a file open: Windows neither removes nor replaces it then."""
    for number in listdir("/proc/self/fd"):
        with suppress(OSError):
            if readlink(f"/proc/self/fd/{number}") == path:
                return True
    return False


def sharing_violation(path: Any) -> PermissionError:
    return PermissionError(errno.EACCES, "The process cannot access the file because it is being used by another", path)


def of_test(path: Any) -> str:
    """Return the path as text if it is in the folder of temporary files, where tests write; otherwise ""."""
    text = os.path.realpath(os.fsdecode(path)) if isinstance(path, (str, bytes, os.PathLike)) else ""
    return text if text.startswith(TEMPORARY) else ""


def audit(event: str, args: tuple[Any, ...]) -> None:
    """Refuse what Windows refuses."""
    if event == "open":
        path, _, flags = args
        if not (text := of_test(path)):
            return
        if os.path.isdir(text):
            raise PermissionError(errno.EACCES, "a folder cannot be opened", path)
        if flags & (os.O_WRONLY | os.O_RDWR) and re.search(r'[<>:"|?*\x00-\x1f]|[. ]$', os.path.basename(text)):
            raise OSError(errno.EINVAL, "the name is not possible on Windows", path)
    elif event in ("os.remove", "os.rename"):
        for path in args[:1] if event == "os.remove" else args[:2]:
            if (text := of_test(path)) and open_here(text):
                raise sharing_violation(path)


def install() -> None:
    """Make this Python lack what Windows lacks."""
    # signals reach no thread that waits for a lock: as there, the handler of the system runs in another thread
    wanted = {signal.SIGINT, signal.SIGTERM, signal.SIGQUIT}
    mask = signal.pthread_sigmask

    def receive() -> None:
        mask(signal.SIG_UNBLOCK, wanted)
        threading.Event().wait()

    mask(signal.SIG_BLOCK, wanted)
    threading.Thread(target=receive, daemon=True).start()

    selectors.DefaultSelector = selectors.SelectSelector  # type: ignore[misc,assignment]
    more: dict[types.ModuleType, dict[str, Any]] = {
        os: {"O_BINARY": os.O_NOCTTY, "O_NOINHERIT": os.O_CLOEXEC, "open": open_file},
        signal: {"SIGBREAK": signal.SIGQUIT, "CTRL_BREAK_EVENT": signal.SIGQUIT},
        socket: {"SO_EXCLUSIVEADDRUSE": socket.SO_KEEPALIVE, "socketpair": tcp_pair},
        shutil: {"disk_usage": disk_usage},
        errno: {"WSAEWOULDBLOCK": errno.EINPROGRESS},
        subprocess: {"CREATE_NEW_PROCESS_GROUP": 0x200, "Popen": Popen},
        ctypes: {"WinDLL": Kernel, "get_last_error": lambda: last_errors[0], "FormatError": str},
        time: {
            "time_ns": lambda: time_ns() // STEP_NS * STEP_NS,
            "monotonic_ns": lambda: time.perf_counter_ns() // STEP_NS * STEP_NS,
        },
    }
    for module, words in ABSENT.items():
        for word in words.split():
            if hasattr(module, word):
                delattr(module, word)
    for module, values in more.items():
        for word, value in values.items():
            setattr(module, word, value)
    for word in ("sendmsg", "recvmsg", "recvmsg_into"):
        setattr(socket.socket, word, property(no_attribute))
    sys.modules["msvcrt"] = msvcrt = types.ModuleType("msvcrt")
    msvcrt.get_osfhandle, msvcrt.kbhit = (lambda handle: handle), (lambda: False)  # type: ignore[attr-defined]
    for word in MODULES.split():
        sys.modules[word] = None  # type: ignore[assignment]
    for word in NATIVE:
        sys.modules[f"igtl_gateway.{word}"] = None  # type: ignore[assignment]
    os.umask(0)
    sys.platform = "win32"
    sys.addaudithook(audit)


install()
