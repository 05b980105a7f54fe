"""Compile a ROS 2 interface package to one Python extension, without ament and CMake.

    python -P build.py PACKAGE DEFINITIONS PREFIX WORK [LIBRARIES]    writes WORK/result/PACKAGE

WORK is an empty folder.  The standard output has a line for each part of the work that begins or ends: the shares of
the whole that are done and that are under way, 0 to 1.  When the standard input ends, because the program that has
started this one was killed, or with SIGTERM, it ends with all that it has started, and removes WORK.

LIBRARIES is the folder of the libraries of the ROS wheels as the extension looks for it (default: PREFIX/lib);
``$ORIGIN`` is its own folder.  The result does not depend on the folders PREFIX and WORK otherwise.

It runs as a program, in a separate process.  Strategy: call the code generators of the ROS wheels with the arguments
that CMake would use, for messages and services.  Their code for C, Python and the two type supports that
rmw_fastrtps_cpp requests is compiled to one extension ``PACKAGE_s__rosidl_typesupport_c``.  ``dispatch.h`` replaces the
generator of rosidl_typesupport_c, which is not called.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Generator → the header with its visibility macros, from a template that CMake would fill in.
_VISIBILITY = {
    generator: f"{generator}__visibility_control.h"
    for generator in ("rosidl_generator_c", "rosidl_typesupport_introspection_c", "rosidl_typesupport_fastrtps_c")
}

#: Libraries of each interface package: ``lib{package}__{name}.so`` for these names.
_LIBRARIES_OF_A_PACKAGE = (
    "rosidl_generator_c",
    "rosidl_generator_py",
    "rosidl_typesupport_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
)
_LIBRARIES = (
    "fastcdr",
    "rcutils",
    "rosidl_runtime_c",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_fastrtps_cpp",
    "rosidl_typesupport_introspection_c",
)

_DISPATCH = Path(__file__).with_name("dispatch.h")

#: Shares of the whole that are done when the definitions are read, and when all code is generated; measured.
_READ, _GENERATED = 0.07, 0.38
#: End of the name of a unit → seconds that it takes, and of all others; measured.
_UNIT_S = {"__type_support_c.cpp": 7.0, "all_s.c": 3.8, "all__functions.c": 3.2, "all__type_support.c": 1.5}
_OTHER_UNIT_S = 0.25
#: Time that compilers have to end, before the work folder is removed.
_END_S = 0.2


class _Report:
    """Reports to the program that has started this one what shares of the work are done and under way."""

    def __init__(self) -> None:
        self._handle = os.dup(1)
        os.dup2(2, 1)  # the generators print
        self._done = self._under_way = 0.0
        self._lock = threading.Lock()

    def begins(self, share: float) -> None:
        self._write(0.0, share)

    def ends(self, share: float) -> None:
        self._write(share, -share)

    def _write(self, done: float, under_way: float) -> None:
        with self._lock:
            self._done += done
            self._under_way += under_way
            os.write(self._handle, b"%.4f %.4f\n" % (self._done, self._under_way))


@dataclass(frozen=True, slots=True)
class Package:
    """An interface package, and the folders of its compilation.

    Attributes:
        name: of the package.
        definitions: folder with ``msg/*.msg`` and ``srv/*.srv``.
        prefix: folder with ``share``, ``include`` and ``lib`` of the wheels.
        work: folder for all generated files.
        libraries: folder of the libraries of the wheels, for the extension.
        interfaces: the definition files, relative to ``definitions``.
    """

    name: str
    definitions: Path
    prefix: Path
    work: Path
    libraries: str
    interfaces: tuple[Path, ...]

    @property
    def generated(self) -> Path:
        """The folder of the generated code: a Python package, and C headers that are included as ``PACKAGE/...``."""
        return self.work / self.name

    @property
    def introspection(self) -> Path:
        """The folder for the code of the introspection generator: its files have the names of another generator's."""
        return self.work / "introspection" / self.name

    @property
    def kinds(self) -> list[str]:
        """The existing subfolders: ``msg``, ``srv``."""
        return sorted({path.parts[0] for path in self.interfaces})

    def idl(self, interface: Path) -> Path:
        """Return the path of the generated IDL of a definition."""
        return self.generated / interface.with_suffix(".idl")

    def arguments(self, file: str, generator: str = "", **more: object) -> str:
        """Write the arguments of a generator to a JSON file, and return its path."""
        content: dict[str, object] = {
            "package_name": self.name,
            "output_dir": str(self.generated),
            "idl_tuples": [f"{self.generated}:{path.with_suffix('.idl')}" for path in self.interfaces],
            "ros_interface_dependencies": [],
            "target_dependencies": [],
            **more,
        }
        if generator:
            content["template_dir"] = str(self.prefix / "share" / generator / "resource")
        path = self.work / f"{file}.json"
        path.write_text(json.dumps(content))
        return str(path)


def generate(package: Package, report: _Report) -> None:
    """Generate all C, C++ and Python code of the package, below ``package.generated``."""
    import rosidl_parser.parser

    # Six generators parse each file again: half of the total time.  Patch the parser before they import it.
    rosidl_parser.parser.parse_idl_file = _once_per_file(rosidl_parser.parser.parse_idl_file)
    from rosidl_adapter import convert_to_idl
    from rosidl_generator_type_description import generate_type_hash

    report.begins(_READ)
    for interface in package.interfaces:
        package.idl(interface).parent.mkdir(parents=True, exist_ok=True)
        convert_to_idl(package.definitions, package.name, interface, package.generated)
    report.ends(_READ / 3)
    share = package.prefix / "share"
    others = [f"{path.name}:{path}" for path in share.iterdir() if path.name != package.name]
    generate_type_hash(package.arguments("type_hash", include_paths=others))
    # always those of msg: the code for services includes them too
    for kind in {*package.kinds, "msg"}:
        (package.generated / kind).mkdir(exist_ok=True)
        for generator, header in _VISIBILITY.items():
            text = (share / generator / "resource" / f"{header}.in").read_text()
            text = text.replace("@PROJECT_NAME@", package.name).replace("@PROJECT_NAME_UPPER@", package.name.upper())
            (package.generated / kind / header).write_text(text)
    # Processes, because generators have global state; forked, so that they inherit the parsed files.
    report.ends(_READ * 2 / 3)
    part = (_GENERATED - _READ) / len(_GENERATORS)
    context = multiprocessing.get_context("fork")
    # No multiprocessing.Pool: its end kills workers, and one that still holds the lock of the results blocks it.
    with ProcessPoolExecutor(os.cpu_count(), context) as pool:
        jobs = [pool.submit(_generate, package, name) for name in _GENERATORS]
        report.begins(part * len(jobs))
        for job in as_completed(jobs):
            job.result()
            report.ends(part)
    (package.generated / "__init__.py").touch()
    (package.generated / "dispatch.c").write_text(_dispatch(package))


def _once_per_file(parse: Callable[[Any], object]) -> Callable[[Any], object]:
    results: dict[Path, object] = {}

    def parse_once(locator: Any) -> object:
        path = locator.get_absolute_path()
        if path not in results:
            results[path] = parse(locator)
        return results[path]

    return parse_once


def _generate_c(package: Package) -> None:
    from rosidl_generator_c import generate_c

    idl = [path.with_suffix(".idl") for path in package.interfaces]
    generate_c(
        package.arguments(
            "c",
            "rosidl_generator_c",
            type_description_tuples=[f"{path}:{package.generated / path.with_suffix('.json')}" for path in idl],
            ros_interface_files=[str(package.definitions / path) for path in package.interfaces],
        )
    )


def _generate_fastrtps(package: Package) -> None:
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c

    generate_typesupport_fastrtps_c(package.arguments("fastrtps", "rosidl_typesupport_fastrtps_c"))


def _generate_introspection(package: Package) -> None:
    from rosidl_typesupport_introspection_c import generate_c

    output = {"output_dir": str(package.introspection)}
    generate_c(package.arguments("introspection_arguments", "rosidl_typesupport_introspection_c", **output))


def _generate_python(package: Package) -> None:
    from rosidl_generator_py import generate_py

    generate_py(package.arguments("python", "rosidl_generator_py"), ["rosidl_typesupport_c"])


#: The slowest generator is the first.
_GENERATORS: dict[str, Callable[[Package], None]] = {
    "python": _generate_python,
    "c": _generate_c,
    "fastrtps": _generate_fastrtps,
    "introspection": _generate_introspection,
}


def _generate(package: Package, name: str) -> None:
    _GENERATORS[name](package)


def _dispatch(package: Package) -> str:
    """Return C code that finds the type supports of each interface."""
    from rosidl_pycommon import convert_camel_case_to_lower_case_underscore as lower

    lines = [f'#include "{_DISPATCH}"']
    for interface in package.interfaces:
        kind, name = interface.parts[0], interface.stem
        for part in ("functions", "type_support"):
            lines.append(f'#include "{package.name}/{kind}/detail/{lower(name)}__{part}.h"')
        lines.append(f"{'SERVICE' if kind == 'srv' else 'MESSAGE'}({package.name}, {kind}, {name})")
    return "\n".join([*lines, ""])


def compile_extension(package: Package, report: _Report) -> Path:
    """Compile the generated code, and return the path of the extension."""
    import numpy as np

    root = package.prefix / "include"
    outside = [Path(sysconfig.get_path("include")), Path(np.get_include()), root, *sorted(root.iterdir())]
    folders = [package.generated.parent, package.introspection.parent, *outside]
    maps = [f"-ffile-prefix-map={package.work}=.", f"-ffile-prefix-map={package.prefix}=."]
    options = ["-O1", "-fPIC", *maps, *(f"-I{folder}" for folder in folders if folder.is_dir())]
    units = _units(package)
    part = (1 - _GENERATED) / sum(map(_cost, units))

    def compile_unit(source: Path) -> Path:
        report.begins(part * _cost(source))
        compiled = _compile(source, options)
        report.ends(part * _cost(source))
        return compiled

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compile_unit, units))
    extension = package.generated / f"{package.name}_s__rosidl_typesupport_c.so"
    libraries = [package.prefix / "lib" / f"lib{name}.so" for name in _LIBRARIES]
    for name in sorted(_needed(package)):
        of_package = [package.prefix / "lib" / f"lib{name}__{library}.so" for library in _LIBRARIES_OF_A_PACKAGE]
        libraries += [path for path in of_package if path.exists()]
    search = f"-Wl,-rpath,{package.libraries}"
    tuning = ["-s", "-Wl,--as-needed", "-Wl,--allow-shlib-undefined"]
    _run(["g++", "-shared", "-o", extension, *tuning, search, *objects, *libraries])
    return extension


def _units(package: Package) -> list[Path]:
    """Return the translation units: many generated files in each, because most of the time is for common headers."""
    folders = (package.generated, package.introspection)
    sources = [path for folder in folders for path in sorted(folder.rglob("*")) if path.suffix in {".c", ".cpp"}]
    groups: dict[str, list[Path]] = {}
    for source in sources:
        # Other files are units of their own, for example descriptions, which define equal static names.
        match = re.search(r"(__functions\.c|__type_support\.c|__type_support_c\.cpp|_s\.c)$", source.name)
        groups.setdefault(match[1] if match else str(source), []).append(source)
    units = []
    for name, members in groups.items():
        if len(members) == 1:
            units += members
            continue
        unit = package.work / f"all{name}"
        unit.write_text("".join(f'#include "{member}"\n' for member in members))
        units.append(unit)
    # The C++ unit is the slowest, so it is the first.
    return sorted(units, key=lambda unit: unit.suffix != ".cpp")


def _cost(unit: Path) -> float:
    return next((seconds for end, seconds in _UNIT_S.items() if unit.name.endswith(end)), _OTHER_UNIT_S)


def _compile(source: Path, options: list[str]) -> Path:
    compiler = ["gcc", "-std=gnu11"] if source.suffix == ".c" else ["g++", "-std=c++17"]
    compiled = source.with_suffix(f"{source.suffix}.o")
    _run([*compiler, *options, "-c", source, "-o", compiled])
    return compiled


def _run(command: list[str | Path]) -> None:
    run = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
    if run.returncode:
        raise RuntimeError(run.stdout.decode(errors="replace"))


def _needed(package: Package) -> set[str]:
    """Return the packages whose interfaces this package uses."""
    definitions = [package.idl(interface).read_text("iso-8859-1") for interface in package.interfaces]
    found = {name for text in definitions for name in re.findall(r'#include "(\w+)/msg/', text)}
    services = {"service_msgs", "builtin_interfaces"} if "srv" in package.kinds else set()
    return (found | services) - {package.name}


def main(arguments: list[str]) -> None:
    """Compile the package, and copy the files for its import, with the definitions for programs that read them."""
    name, definitions, prefix, work, *libraries = arguments
    folder = Path(definitions).resolve()
    files = sorted([*folder.glob("msg/*.msg"), *folder.glob("srv/*.srv")])
    interfaces = tuple(path.relative_to(folder) for path in files)
    (place,) = libraries or [f"{prefix}/lib"]
    package = Package(name, folder, Path(prefix), Path(work), place, interfaces)
    is_ending = _end_with_parent(package.work)
    try:
        _make(package)
    finally:
        if is_ending.is_set():  # its processes are gone, which is an error here: the end comes from there
            threading.Event().wait()


def _make(package: Package) -> None:
    folder, report = package.definitions, _Report()
    generate(package, report)
    extension = compile_extension(package, report)
    result = package.work / "result" / package.name
    for kind in package.kinds:
        (result / kind).mkdir(parents=True)
        for path in [*package.generated.glob(f"{kind}/*.py"), *folder.glob(f"{kind}/*.{kind}")]:
            shutil.copy(path, result / kind)
    shutil.copy(package.generated / "__init__.py", result)
    shutil.copy(extension, result)
    for path in result.rglob("*.*"):  # a rename of the folder may reach the disk before them
        _sync(path)


def _sync(path: Path) -> None:
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _end_with_parent(work: Path) -> threading.Event:
    """Leave nothing behind if the program that has started this one is gone; return whether this is under way."""
    own, is_ending = os.getpid(), threading.Event()

    def on_signal(_number: int, _frame: Any) -> None:
        if os.getpid() != own:  # a process that generates code
            os._exit(1)
        if not is_ending.is_set():  # else it comes from below
            threading.Thread(target=leave, daemon=True).start()

    def leave() -> None:
        is_ending.set()
        os.killpg(own, signal.SIGTERM)
        threading.Event().wait(_END_S)
        shutil.rmtree(work, ignore_errors=True)
        os.killpg(own, signal.SIGKILL)

    def watch() -> None:
        while os.read(0, 1):
            pass
        leave()

    signal.signal(signal.SIGTERM, on_signal)
    threading.Thread(target=watch, daemon=True).start()
    return is_ending


if __name__ == "__main__":
    main(sys.argv[1:])
