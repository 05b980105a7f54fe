"""Programs in C++ for the judges, compiled against packages of ROS 2 that are there, built."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from pathlib import Path

PROGRAMS = Path(__file__).with_name("programs")
#: What each program links.
LIBRARIES = (
    "rclcpp", "libstatistics_collector", "rcl", "rcutils", "rcpputils", "rmw", "tracetools", "rosidl_runtime_c",
    "rosidl_typesupport_cpp", "std_msgs__rosidl_typesupport_cpp", "statistics_msgs__rosidl_typesupport_cpp",
)  # fmt: skip


def compiled(source: str, folder: Path, prefixes: Iterable[Path], libraries: Sequence[str] = LIBRARIES) -> Path:
    """Compile a program of ``programs`` into the folder; a library if it has no ``main``.

    Args:
        prefixes: folders with ``include/PACKAGE`` and ``lib``, as an installed ROS 2 has.
    """
    path = PROGRAMS / source
    has_main = "int main(" in path.read_text("utf-8")
    target = folder / (path.stem if has_main else f"lib{path.stem}.so")
    command = ["g++", "-std=c++17", "-O1", "-o", str(target), str(path), "-pthread"]
    command += [] if has_main else ["-shared", "-fPIC"]
    for each in (Path(sys.prefix), *prefixes):
        command += [f"-I{each}/include", *(f"-I{path}" for path in (each / "include").iterdir() if path.is_dir())]
        command += [f"-L{each}/lib", f"-Wl,-rpath,{each}/lib"]
    library = sysconfig.get_config_var("LIBDIR")
    command += ["-Wl,--no-as-needed,--allow-shlib-undefined", f"-L{library}", f"-Wl,-rpath,{library}"]
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"  # libraries of messages need it
    subprocess.run([*command, *(f"-l{each}" for each in (version, *libraries))], check=True)
    return target


def environment(prefixes: Sequence[Path]) -> dict[str, str]:
    """Variables of a sourced ROS 2: where packages, their libraries and their Python modules are; ours come first."""
    prefixes = [Path(sys.prefix), *prefixes]
    python = f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
    vendored = (Path(sys.prefix) / python).glob("ros_*.libs")  # what the wheels bring with them
    return {
        "AMENT_PREFIX_PATH": _joined(prefixes),
        "LD_LIBRARY_PATH": _joined([*(prefix / "lib" for prefix in prefixes), *vendored]),
        "PYTHONPATH": _joined(prefix / python for prefix in prefixes[1:]),
    }


def _joined(paths: Iterable[Path]) -> str:
    return os.pathsep.join(map(str, paths))


def version_of(package: str, prefixes: Sequence[Path]) -> str:
    """The version in the manifest of a package."""
    found = next(path for prefix in prefixes if (path := prefix / "share" / package / "package.xml").is_file())
    return found.read_text("utf-8").partition("<version>")[2].partition("</version>")[0]


def executable(package: str, name: str, prefixes: Sequence[Path]) -> Path:
    """Return the path of an executable of a package.  Raises StopIteration if none has it."""
    return next(path for prefix in prefixes if (path := prefix / "lib" / package / name).is_file())
