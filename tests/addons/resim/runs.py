"""Runs of the programs of these tests."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

from igtl_gateway.addon.reading import SessionFile
from igtl_gateway.addons.resim.engine import Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.verdict import Verdict, compare

PROGRAMS = Path(__file__).with_name("programs")
#: Of one recording.  The verdict must be the same for any number of runs.
RUNS = 5


def program(name: str, *arguments: str) -> Program:
    """A program of the folder ``programs``."""
    return Program((sys.executable, str(PROGRAMS / f"{name}.py"), *arguments), name)


def compiled(name: str, folder: Path) -> Path:
    """A program in C, compiled with what the ROS wheels have."""
    prefix, place = Path(sys.prefix), sysconfig.get_config_var("LIBDIR")
    libraries = ["rcl", "rcutils", "rmw", "std_msgs__rosidl_typesupport_c", "std_msgs__rosidl_generator_c"]
    command = ["cc", "-O1", "-o", str(folder / name), str(PROGRAMS / f"{name}.c")]
    command += [f"-I{each}" for each in (prefix / "include").iterdir()]
    command += [f"-L{prefix}/lib", f"-L{place}", f"-Wl,-rpath,{place}", "-Wl,--no-as-needed,--allow-shlib-undefined"]
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"  # libraries of messages need it
    command += [f"-l{each}" for each in (version, *libraries, "rosidl_runtime_c")]
    subprocess.run(command, check=True)
    return folder / name


def judged(
    recording: Path, folder: Path, *names: str, runs: int = RUNS, reference: Path | None = None, **options: Any
) -> tuple[RunResult, Verdict]:
    """Run programs by name; the result and its verdict."""
    result = run(recording, [program(*name.split()) for name in names], ResimOptions(runs=runs, **options), folder)
    return result, compare(result, reference=reference)


def published(path: Path, topic: str) -> list[tuple[int, bytes]]:
    """The messages of a topic in a file of outputs: session time and CDR."""
    with SessionFile.open(path) as file:
        return [(entry.source_ns or entry.stamp_ns, entry.data()) for entry in file.entries() if entry.channel == topic]


def strings(path: Path, topic: str) -> list[str]:
    """The strings of a topic of std_msgs/msg/String."""
    return [data[8:-1].split(b"\0")[0].decode() for _, data in published(path, topic)]
