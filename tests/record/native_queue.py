"""The native writer of the recorder's queue, compiled as a library of its own for the tests."""

from __future__ import annotations

import ctypes
import shlex
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.places import ROOT

HEADER = ROOT / "igtl_gateway" / "native" / "kernel" / "_queue.h"

_SHIM = """
#include "_queue.h"
int put(void *memory, uint64_t stream, uint64_t number, uint64_t stamp_ns, uint64_t source_ns, const void *payload,
        uint64_t size)
{
    struct queue queue = queue_open(memory);
    return queue_put(&queue, stream, number, stamp_ns, source_ns, payload, size);
}
int fits(void *memory, uint64_t entries, uint64_t payload_bytes)
{
    struct queue queue = queue_open(memory);
    return queue_fits(&queue, entries, payload_bytes);
}
"""


def native_library(folder: Path) -> ctypes.CDLL:
    """``put`` and ``fits`` of the native writer; skips the test without a compiler."""
    source, target = folder / "shim.c", folder / "shim.so"
    source.write_text(_SHIM)
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    words = [compiler, "-O2", "-Wall", "-Wextra", "-Werror", "-std=gnu11", "-shared", "-fPIC", f"-I{HEADER.parent}"]
    try:
        subprocess.run([*words, "-o", target, source], check=True)
    except FileNotFoundError:
        pytest.skip("no C compiler")
    return ctypes.CDLL(str(target))
