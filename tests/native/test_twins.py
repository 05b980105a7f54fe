"""Rules that stand more than once, for speed: each twin gives what the definition gives, bit for bit.

"Twins" in ARCHITECTURE.md lists them: the guard of a stream, the CRC, rotations.
"""

from __future__ import annotations

import math
import random
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from igtl_gateway.api.igtl_columns import crcs, quaternions_of, rotations
from igtl_gateway.base.buffers import join
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S
from igtl_gateway.convert import express, poses
from igtl_gateway.convert.rosmsg import Header, TransformStamped
from igtl_gateway.gateway.guarded_stream import STILL_LOOKS, GuardedStream, Place, Remark
from igtl_gateway.wire import HEADER_SIZE, Message, encode
from igtl_gateway.wire.header import crc64
from igtl_gateway.wire.transform import Position, Transform
from tests.places import PACKAGE
from tests.wire import handmade

passage = pytest.importorskip("igtl_gateway.native._passage", reason="installed without the C part")
compiled = pytest.importorskip("igtl_gateway.native._express", reason="installed without the C part")

# -- the guard of a stream ----------------------------------------------------------------------------------------

T0_NS = 1_700_000_000 * NS_PER_S
XYZ = struct.Struct(">3f")

#: Gateway time, stamp of the message (0: none), translation (None: not a pose).
Arrival = tuple[int, int, Place | None]


def by_definition(watched: GuardedStream, now_ns: int, own_ns: int, place: Place | None) -> tuple[bool, list[Remark]]:
    """Whether the message is withheld, and the remarks."""
    withheld, remarks = watched.judge(now_ns, own_ns)
    return withheld, remarks + watched.observe(now_ns, own_ns or now_ns, place)


def in_python(watched: GuardedStream, now_ns: int, own_ns: int, place: Place | None) -> tuple[bool, list[Remark]]:
    """The same, with the quick way in front."""
    data, numbers = (XYZ.pack(*place), XYZ) if place else (b"", None)
    if watched.passes_quickly(now_ns, own_ns or now_ns, data, numbers, 0):
        return False, []
    return by_definition(watched, now_ns, own_ns, place)


class InC:
    """The same, with the passage in front; it has the state, and gives it to Python where Python judges."""

    def __init__(self) -> None:
        self.guard = passage.Guard()
        self.passed = 0

    def __call__(
        self, watched: GuardedStream, now_ns: int, own_ns: int, place: Place | None
    ) -> tuple[bool, list[Remark]]:
        self.guard.set(*watched.native_state())
        passed = self.guard.passes(now_ns, own_ns or now_ns, *(place or ()))
        assert self.guard.is_dirty == passed, "what does not pass changes nothing"
        if passed:
            watched.after_native(*self.guard.collect())
            self.passed += 1
            return False, []
        return by_definition(watched, now_ns, own_ns, place)


def arrivals(rng: random.Random, max_age_ns: int, ahead_ns: int) -> Iterator[Arrival]:
    """A stream that is plain for some time, and odd for some: around each limit by a nanosecond."""
    now_ns, stamp_ns, place = T0_NS, T0_NS, (100.0, 200.0, 300.0)
    has_pose = rng.random() < 0.7
    ages = [0, 1, -1, max_age_ns, max_age_ns + 1, max_age_ns - 1, -100 * NS_PER_MS, -100 * NS_PER_MS - 1]
    for _ in range(rng.choice([3, 30])):
        kind = rng.choice(["plain", "plain", "age", "none", "still", "back", "jump", "mixed", "late"])
        step_ns = rng.choice([NS_PER_MS, 10 * NS_PER_MS, 99 * NS_PER_MS, 100 * NS_PER_MS, 101 * NS_PER_MS, NS_PER_S])
        for _ in range(rng.choice([1, 5, STILL_LOOKS + 2])):
            now_ns += step_ns
            one = rng.choice(["plain", "age", "none", "still", "back", "jump"]) if kind == "mixed" else kind
            if one in ("plain", "jump"):
                stamp_ns = now_ns - ahead_ns - rng.randrange(NS_PER_MS)
            elif one == "age":
                stamp_ns = now_ns - ahead_ns - rng.choice(ages)
            elif one == "back":
                stamp_ns -= rng.choice([1, NS_PER_MS])
            elif one == "late":
                now_ns += 10 * NS_PER_S - step_ns + rng.choice([-1, 0, 1])
                stamp_ns = now_ns - ahead_ns - 1
            if one == "jump":
                factor = rng.choice([1e-3, 1e3, 499.0, 501.0, 99.0, 101.0, 0.0, -1000.0])
                place = (place[0] * factor, place[1] * factor, place[2] * factor)
                place = place if 1e-6 < math.hypot(*place) < 1e9 else (100.0, 200.0, 300.0)
            elif rng.random() < 0.05:
                place = rng.choice([(0.0, 0.0, 0.0), (1e-3, 0.0, 0.0), (100.0, 200.0, 300.0)])
            shown: Place = XYZ.unpack(XYZ.pack(*place))
            yield now_ns, 0 if one == "none" else stamp_ns, shown if has_pose else None


def state_of(watched: GuardedStream) -> list[Any]:
    timing = {name: getattr(watched.timing, name) for name in type(watched.timing).__slots__}
    if not watched.native_state()[0]:  # not watched: only its age is judged
        return [watched.native_state()[:4], watched.stale, watched.episodes]
    return [*watched.native_state(), watched.stale, watched.episodes, watched.age_ns, timing]


@pytest.mark.parametrize("twin", ["python", "c"])
def test_a_stream_passes_a_twin_of_the_guard_if_there_is_nothing_to_report(twin: str) -> None:
    rng = random.Random(30)
    quick = reported = withheld_in_all = 0
    for _ in range(400):
        max_age_ns = rng.choice([0, 0, 50 * NS_PER_MS, NS_PER_S])
        ahead_ns = rng.choice([0, 0, 0, 3 * NS_PER_S])
        watch = rng.random() < 0.9
        expected, found = (GuardedStream("Tool", max_age_ns, watch=watch) for _ in range(2))
        expected.ahead_ns = found.ahead_ns = ahead_ns
        judge = InC() if twin == "c" else in_python
        for now_ns, own_ns, place in arrivals(rng, max_age_ns, ahead_ns):
            withheld, remarks = by_definition(expected, now_ns, own_ns, place)
            assert judge(found, now_ns, own_ns, place) == (withheld, remarks)
            assert state_of(found) == state_of(expected)
            reported += bool(remarks)
            withheld_in_all += withheld
        quick += judge.passed if isinstance(judge, InC) else 0
    assert reported > 1000 and withheld_in_all > 100
    assert twin == "python" or quick > 10_000


# -- CRC ----------------------------------------------------------------------------------------------------------

BYTES = random.Random(64).randbytes(4 * 2**20 + 16)
both: Callable[..., Any] = (
    compiled.crc64_both
)  # (data, CRC of the bytes before) → CRC as the processor allows, and with tables


@pytest.mark.parametrize("alignment", range(16))
def test_crc_of_all_sizes_at_all_alignments(alignment: int) -> None:
    view = memoryview(BYTES)
    for size in range(4097):
        part = view[alignment : alignment + size]
        assert both(part, 0) == (crc64(part),) * 2, size


@pytest.mark.parametrize("size", [65_535, 1_000_000, 2**20, 4 * 2**20])
def test_crc_of_many_bytes(size: int) -> None:
    assert both(BYTES[:size], 0) == (crc64(BYTES[:size]),) * 2


def test_crc_in_pieces() -> None:
    rng = random.Random(65)
    for _ in range(200):
        begin = at = rng.randrange(16)
        crc = 0
        for _ in range(rng.randrange(1, 6)):
            part = BYTES[at : at + rng.choice([rng.randrange(32), rng.randrange(600), rng.randrange(40_000)])]
            folded, plain = both(part, crc)
            assert folded == plain
            crc, at = folded, at + len(part)
        assert crc == crc64(BYTES[begin:at])


def test_crc_of_the_catalogue() -> None:
    assert both(b"123456789", 0) == (0x6C40DF5F0B497347,) * 2
    assert handmade.crc64(b"123456789") == crc64(b"123456789") == 0x6C40DF5F0B497347


@pytest.mark.parametrize("size", [1, 7, 28, 48, 255, 256, 300])
def test_crcs_of_rows(size: int) -> None:
    rows = np.frombuffer(BYTES[: 50 * size], np.uint8).reshape(50, size)
    assert crcs(rows).tolist() == [crc64(row.tobytes()) for row in rows]


# -- rotations ----------------------------------------------------------------------------------------------------

Quaternion = tuple[float, float, float, float]


def quaternions() -> list[Quaternion]:
    """Quaternions x, y, z, w: random ones, half turns, ties between components, zeros of both signs, any length."""
    rng = random.Random(33)
    found: list[Quaternion] = []
    for number in range(3000):
        parts = [rng.gauss(0.0, 1.0) for _ in range(4)]
        if number % 3 == 1:
            parts = [rng.choice([0.0, -0.0, 1.0, -1.0, 0.5, -0.5]) for _ in range(4)]
        elif number % 3 == 2:
            parts[rng.randrange(4)] *= rng.choice([1e-8, 1e-20, 0.0, -0.0])
        length = math.hypot(*parts) or 1.0
        scale = rng.choice([1.0, 1.0, 1e-30, 1e30]) / length
        x, y, z, w = (part * scale for part in parts)
        found.append((x, y, z, w))
    return [*found, (0.0, 0.0, 0.0, 0.0), (1e200, 1e200, 0.0, 0.0), (1e-200, 0.0, 0.0, 0.0)]


def matrices() -> list[tuple[float, ...]]:
    """Columns of 3 × 3 matrices in float32: rotations, and some at the limit, reflected, scaled or singular."""
    rng = random.Random(34)
    found: list[tuple[float, ...]] = []
    for quaternion in quaternions():
        try:
            rows = poses.rotation_matrix(poses.unit_quaternion(quaternion))
        except ConversionError:
            continue
        factor = rng.choice([1.0] * 5 + [1 + 4.9e-6, 1 + 5.1e-6, 1 - 5e-6, -1.0, 1.01, 0.0])
        columns = [factor * rows[row][column] for column in range(3) for row in range(3)]
        if rng.random() < 0.1:
            columns[rng.randrange(9)] += rng.choice([1e-5, -1e-5, 9.9e-6, 0.5])
        found.append(struct.unpack(">9f", struct.pack(">9f", *columns)))
    return found


SAMPLE = join(encode(Message("TRANSFORM", "Probe", Transform((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0, 0, 0, 0)), 0)))
TEMPLATE = TransformStamped(Header(0, "igtl"), "Probe", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).pack()


def quaternion_of(function: Callable[..., Any], columns: tuple[float, ...]) -> bytes | None:
    """The quaternion that a compiled conversion gives a matrix; None: it leaves the message to the full path."""
    data = join(encode(Message("TRANSFORM", "Probe", Transform((*columns, 0.0, 0.0, 0.0)), 0)))
    made = function(data, SAMPLE, HEADER_SIZE, express.MATRIX, True, True, T0_NS, (1.0, 1000.0), ((TEMPLATE, 4),))
    return made[2][-32:] if made else None


def test_the_quaternion_of_a_matrix() -> None:
    seen, left = 0, 0
    given = matrices()
    wide = np.zeros((len(given), 4, 4))
    wide[:, :3, :3] = np.array(given).reshape(-1, 3, 3).transpose(0, 2, 1)
    columns, valid = quaternions_of(wide)
    for number, matrix in enumerate(given):
        rows = [[matrix[3 * column + row] for column in range(3)] for row in range(3)]
        try:
            expected = struct.pack("<4d", *poses.nearest_quaternion(rows, "matrix"))
        except ConversionError:
            expected = None
        exact = poses.distance_from_rotation(rows) <= poses.ROUNDING
        found = [quaternion_of(function, matrix) for function in (compiled.pose_to_ros, express.PLAIN[0])]
        assert found == [expected if exact else None] * 2, rows
        assert (struct.pack("<4d", *columns[number]) if valid[number] else None) == expected, rows
        seen, left = seen + (found[0] is not None), left + (found[0] is None)
    assert seen > 1000 and left > 300


def test_the_matrix_of_a_quaternion() -> None:
    sample = TEMPLATE
    first_end = 12 + 4 + len("igtl") + 1
    second = first_end + -first_end % 4
    names = (first_end, second, second + 4 + len("Probe") + 1)
    given = quaternions()
    wide = rotations(np.array(given))
    refused = 0
    for number, quaternion in enumerate(given):
        try:
            rows = poses.rotation_matrix(poses.unit_quaternion(quaternion))
            expected = [rows[row][column] for column in range(3) for row in range(3)]
        except ConversionError:
            expected = None
        cdr = sample[:-32] + struct.pack("<4d", *quaternion)
        for function in (compiled.pose_to_igtl, express.PLAIN[1]):
            made = function(
                cdr, sample, names, express.MATRIX, True, 0, T0_NS, (1000.0, 1.0), ((SAMPLE, HEADER_SIZE, 0),)
            )
            found = made[1][HEADER_SIZE : HEADER_SIZE + 36] if made else None
            assert found == (struct.pack(">9f", *expected) if expected else None), quaternion
        columns = wide[number].T.reshape(-1).tolist()
        assert np.isnan(columns).all() if expected is None else columns == expected, quaternion
        refused += expected is None
    assert refused >= 2


def test_the_sign_of_a_quaternion() -> None:
    """Also where only x is not 0, which no matrix gives."""
    sample = join(encode(Message("POSITION", "Probe", Position((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), 0)))
    for quaternion in [*quaternions(), (-2.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, -0.0)]:
        if not all(abs(value) < 1e38 for value in quaternion):
            continue
        data = sample[: HEADER_SIZE + 12] + struct.pack(">4f", *quaternion)
        received = struct.unpack(">4f", data[HEADER_SIZE + 12 :])
        try:
            expected = struct.pack("<4d", *poses.canonical_quaternion(poses.unit_quaternion(received)))
        except ConversionError:
            expected = None
        for function in (compiled.pose_to_ros, express.PLAIN[0]):
            made = function(
                data, sample, HEADER_SIZE, express.QUATERNION, False, True, T0_NS, (1.0, 1000.0), ((TEMPLATE, 4),)
            )
            assert (made[2][-32:] if made else None) == expected, quaternion


# -- other machines -----------------------------------------------------------------------------------------------


@pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc here")
@pytest.mark.parametrize("machine", ["__SIZEOF_SIZE_T__=4", "__BYTE_ORDER__=__ORDER_BIG_ENDIAN__", ""])
def test_the_c_parts_refuse_machines_that_they_are_not_for(machine: str) -> None:
    """A length of 32 unsigned bits would be negative in a ssize_t of 32 bits, and pass the checks of bounds."""
    others = [f"-U{machine.partition('=')[0]}", f"-D{machine}"] if machine else []
    command = ["gcc", "-E", "-x", "c", *others, str(PACKAGE / "native" / "kernel" / "_bytes.h")]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.returncode != 0, "of 64 bits" in run.stderr) == (bool(machine), bool(machine))
