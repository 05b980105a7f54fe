"""Settings of the process that must precede the start of ROS 2, so that large messages are fast.

There are two, each applied only if the user has not chosen another.  Measured with raw bytes from process to
process, one Full HD RGB image took 59 ms with the defaults, 27 ms with the shared-memory profile and
14 ms with the allocator settings on top (28, 74 and 137 images a second):

* Fast DDS gets a profile with a shared-memory transport that takes an image in one piece, and whose publishers and
  subscriptions keep no buffer of their largest message;
* glibc's allocator keeps big blocks instead of giving them back to the kernel after every message: the
  page faults of fresh blocks were half of the cost.

And the shared memory of ROS processes that were killed is freed first.  No other program does that, and each of our
segments takes 34 MiB from the machine and from the next process.

This module does not import rclpy: it runs before the import, and also where rclpy is not installed.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from igtl_gateway.base.quantities import size_text
from igtl_gateway.base.systems import files
from igtl_gateway.base.systems.malloc import tune_malloc
from igtl_gateway.edges.ros_interfaces.cache import make_ready

PROFILE = Path(__file__).with_name("fastdds_profile.xml")
#: The same with quick acknowledgements, for a program that waits for each.
LOCK_STEP_PROFILE = Path(__file__).with_name("fastdds_profile_lock_step.xml")

#: Fast DDS 2 reads the first name, Fast DDS 3 the second; its rmw warns of the first.
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
#: With "1", rmw_fastrtps leaves to the profile how the memory of messages is kept.
QOS_VARIABLE = "RMW_FASTRTPS_USE_QOS_FROM_XML"

#: Fast DDS loads these from the working directory by itself.
_PROFILES_IN_CWD = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")

#: The library of Fast DDS 2 and 3.
_FAST_DDS = ("libfastrtps.", "libfastdds.")

_SHARED_MEMORY = Path("/dev/shm")

#: Memory that one participant owns, of Fast DDS 2 and 3.  (Ports, which all participants share, have other names.)
_SEGMENT = re.compile("fast(?:rtps|dds)_[0-9a-f]{16}")

# Every participant makes a segment of 32 MiB (see the profile).  Where several do not fit, as with the
# 64 MB that containers get by default, Fast DDS cannot send large messages, and its own small default is better.
_SEGMENT_BYTES = 32 << 20
_ROOM_BYTES = 4 * _SEGMENT_BYTES


def prepare_environment(lock_step: bool = False) -> list[str]:
    """Compile missing message packages, and apply both settings where the user has set none.

    Call it before rclpy is imported, and before anything waits for messages: the first start takes up to a minute.
    Changes ``os.environ`` (child processes inherit the profile) and this process's allocator.

    Args:
        lock_step: the program waits for the acknowledgement of each message.

    Returns:
        One line of text for each setting: what was applied, or what was kept and why; one more if memory of killed
        processes was freed.

    Raises KeyboardInterrupt if the compilation was interrupted.
    """
    make_ready()
    freed = free_shared_memory(_SHARED_MEMORY)
    lines = [_set_profile(LOCK_STEP_PROFILE if lock_step else PROFILE), tune_malloc()]
    return [*lines, f"shared memory: freed {size_text(freed)} of killed processes"] if freed else lines


def free_shared_memory(folder: Path) -> int:
    """Remove the segments of Fast DDS whose processes have ended, as ``fastdds shm clean`` does; return the bytes.

    Each segment has a lock file beside it, which its process created and locked before the segment.  If both exist and
    no process holds the lock, the process has ended.
    """
    if sys.platform == "win32":  # has no such folder
        return 0
    freed = 0
    for lock in folder.glob("fast*_*_el"):
        segment = lock.with_name(lock.name.removesuffix("_el"))
        if not _SEGMENT.fullmatch(segment.name):
            continue
        try:
            status = segment.stat()
            if status.st_uid != os.getuid() or not _is_free(lock):
                continue
            segment.unlink()
            freed += status.st_blocks * 512
            lock.unlink()
        except OSError:  # it has just been removed, or belongs to another user
            continue
    return freed


def _is_free(lock: Path) -> bool:
    """Return whether no process holds the lock.  Raises OSError if it is not a regular file; any user may make one."""
    with os.fdopen(files.open_plain(lock), "rb") as file:
        try:
            files.lock(file.fileno())
        except BlockingIOError:
            return False
        return True


def _set_profile(profile: Path) -> str:
    kept = _why_keep_profile(os.environ, Path.cwd(), _SHARED_MEMORY)
    if kept:
        return f"Fast DDS profile: {kept}"
    name = PROFILE_VARIABLES[_is_fast_dds_3(os.environ)]
    os.environ[name] = str(profile)
    os.environ.setdefault(QOS_VARIABLE, "1")
    return f"Fast DDS profile: shared memory for large messages ({name}={profile})"


def _is_fast_dds_3(environ: Mapping[str, str]) -> bool:
    """Whether the sourced ROS 2, else the one of this environment, has Fast DDS 3: its library has another name."""
    prefixes = [*environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    places = [(Path(prefix), place) for prefix in prefixes if prefix for place in ("lib", "lib/*-linux-*")]
    libraries = (path.name for prefix, place in places for path in prefix.glob(f"{place}/libfast*.so*"))
    return next((name.startswith("libfastdds.") for name in libraries if name.startswith(_FAST_DDS)), False)


def _why_keep_profile(environ: Mapping[str, str], cwd: Path, shared_memory: Path) -> str:
    """Return why the profile must not be changed; ``""`` if it may be."""
    # FASTDDS_BUILTIN_TRANSPORTS is a choice of transports too, which our profile would override
    for name in (*PROFILE_VARIABLES, "FASTDDS_BUILTIN_TRANSPORTS"):
        # a child inherits our profile from a program of this package
        if environ.get(name, "") not in ("", str(PROFILE), str(LOCK_STEP_PROFILE)):
            return f"kept the user's ({name}={environ[name]})"
    for name in _PROFILES_IN_CWD:
        if (cwd / name).is_file():
            return f"kept the user's ({cwd / name})"
    rmw = environ.get("RMW_IMPLEMENTATION", "")
    if rmw and "fastrtps" not in rmw:
        return f"not for {rmw}"
    if not shared_memory.is_dir():
        return f"not set, no {shared_memory} here"
    free = shutil.disk_usage(shared_memory).free
    if free < _ROOM_BYTES:
        have, need = free >> 20, _ROOM_BYTES >> 20
        return f"not set, {have} MiB free in {shared_memory}, {need} MiB needed (large images will be slower)"
    return ""
