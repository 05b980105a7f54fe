"""Compile the packages before their first import.

python -m igtl_gateway.edges.ros_interfaces                   for this environment; prints their folders
python -m igtl_gateway.edges.ros_interfaces --ahead FOLDER    for a wheel (tools/release.py)
python -m igtl_gateway.edges.ros_interfaces --remove          before an uninstallation; prints the removed folders
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from igtl_gateway.convert.interfaces import PACKAGES
from igtl_gateway.edges.ros_interfaces.cache import (
    LIBRARIES,
    VERSIONS,
    cache_folders,
    compile_missing,
    is_installed,
    package_path,
    prefix_of,
    ros_versions,
    wheels_folder,
)
from igtl_gateway.edges.ros_interfaces.compiling import compile_package

#: Exit code after Ctrl-C, as a shell has it.
_INTERRUPTED = 130


def main() -> int:
    """Print one line for each package; return 1 if at least one cannot be imported, otherwise 0."""
    if sys.argv[1:2] == ["--ahead"]:
        compile_ahead(Path(sys.argv[2]))
        return 0
    if sys.argv[1:] == ["--remove"]:
        remove_compiled()
        return 0
    failed: dict[str, None] = {}
    with suppress(ImportError):  # the reason comes below
        compile_missing()
    for package in PACKAGES:
        try:
            if is_installed(package):
                real = find_spec(package)
                sys.stdout.write(f"{package}: {Path(str(real and real.origin)).parent} (installed)\n")
            else:
                sys.stdout.write(f"{package}: {package_path(package)[0]}\n")
        except ImportError as error:
            failed[str(error)] = None
    sys.stderr.writelines(f"{line}\n" for line in failed)
    return 1 if failed else 0


def remove_compiled() -> None:
    """Delete the packages that imports have compiled, of all versions: no installer knows of them."""
    for folder in filter(Path.is_dir, cache_folders()):
        shutil.rmtree(folder)
        with suppress(OSError):  # another program has a file there
            folder.parent.rmdir()
        sys.stdout.write(f"removed {folder}\n")


def compile_ahead(folder: Path) -> None:
    """Compile all packages into a new ``folder``, for the wheels of this environment.  Raises ImportError."""
    folder.mkdir()
    for package in PACKAGES:
        wheels = wheels_folder(package)
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            compile_package(package, prefix_of(wheels), work, f"$ORIGIN/{LIBRARIES}")
            (work / "result" / package).rename(folder / package)
        (folder / VERSIONS).write_text(json.dumps(ros_versions(wheels), indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(_INTERRUPTED)
