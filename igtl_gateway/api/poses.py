"""Poses as arrays: matrices with their times, unit and frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from igtl_gateway.api.display import as_array, html_table
from igtl_gateway.api.igtl_columns import quaternions_of, rotations
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of
from igtl_gateway.base.quantities import duration_text
from igtl_gateway.convert.units import UNITS, LengthUnits

Array = npt.NDArray[Any]
Times = npt.NDArray[np.int64]

#: A matrix whose axes are off by more than this part of their length is no rotation that was rounded.
_STRETCHED = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of one frame in another one; for numpy an array of ``matrices``.

    Attributes:
        matrices: (N, 4, 4) float64; each maps coordinates in ``child`` to coordinates in ``parent``.
        unit: unit of the translation: ``"mm"`` or ``"m"``.
        times: (N,) int64, gateway time in UTC nanoseconds.
        source_times: (N,) int64, the sender's stamp; 0 = unset.
        stamps: (N,) int64, the stamp in the message: ``header.stamp`` of ROS, the header of OpenIGTLink; 0 = unset.
        parent: name of the reference frame; ``""`` if the messages have none or several.
        child: name of the frame that moves; ``""`` likewise.
        left_out: number of damaged messages without a pose.
        rows: (N,) int64, index of the message in its stream; -1 without one.
    """

    matrices: Array
    unit: str
    times: Times
    source_times: Times
    stamps: Times
    parent: str = ""
    child: str = ""
    left_out: int = 0
    rows: Times = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.times)

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        return as_array(self.matrices, dtype, copy)

    def __repr__(self) -> str:
        frames = f" of {self.child or '?'} in {self.parent or '?'}" if self.child or self.parent else ""
        seconds = f", {duration_text(int(self.times[-1] - self.times[0]))}" if len(self) else ""
        return f"<Poses: {len(self):,}{frames}, {self.unit}{seconds}>"

    def _repr_html_(self) -> str:
        rows = (
            (number, *(f"{value:.6g}" for value in (*place, *turn)))
            for number, (place, turn) in enumerate(zip(self.positions[:5], self[:5].quaternions, strict=True))
        )
        return html_table(repr(self), ("", *(f"{axis}, {self.unit}" for axis in "xyz"), "qx", "qy", "qz", "qw"), rows)

    def __iter__(self) -> Iterator[Array]:
        return iter(self.matrices)

    @overload
    def __getitem__(self, rows: int | np.integer[Any]) -> Array: ...
    @overload
    def __getitem__(self, rows: slice | npt.NDArray[Any] | list[int] | list[bool]) -> Poses: ...
    def __getitem__(self, rows: Any) -> Poses | Array:
        """The poses of a slice, of a mask or of indices; of one index its (4, 4) matrix."""
        if isinstance(rows, int | np.integer):
            matrix: Array = self.matrices[rows]
            return matrix
        arrays = ("matrices", "times", "source_times", "stamps", "rows")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})

    @property
    def positions(self) -> Array:
        """(N, 3) float64: the origin of ``child`` in ``parent``, in ``unit``."""
        return self.matrices[:, :3, 3]

    @property
    def quaternions(self) -> Array:
        """(N, 4) float64: x, y, z, w with w ≥ 0; NaN where the matrix is not a rotation."""
        return quaternions_of(self.matrices)[0]

    def in_unit(self, unit: str) -> Poses:
        """Return the poses in another unit of length.

        Args:
            unit: ``"m"``, ``"dm"``, ``"cm"``, ``"mm"`` or ``"um"``.

        Raises:
            ConfigError: the unit is unknown.
        """
        times, by = ratio(self.unit, unit)
        if times == by:
            return self
        matrices = self.matrices.copy()
        matrices[:, :3, 3] *= times
        matrices[:, :3, 3] /= by
        return replace(self, matrices=matrices, unit=unit)

    def inverse(self) -> Poses:
        """Return the poses of ``parent`` in ``child``.  The matrices must be rotations."""
        return replace(self, matrices=inverse(self.matrices), parent=self.child, child=self.parent)


def ratio(unit: str, wanted: str) -> tuple[int, int]:
    """Return numerator and denominator that convert lengths.  Raises ConfigError for an unknown unit."""
    for name in (unit, wanted):
        if name not in UNITS:
            raise ConfigError(f"unit: found {name!r}, expected {one_of(name, UNITS)}")
    return LengthUnits(wanted, unit).ratio_to_ros


def inverse(matrices: Array) -> Array:
    """Return the inverse of rigid transforms (…, 4, 4)."""
    found = np.zeros_like(matrices)
    rotation = np.swapaxes(matrices[..., :3, :3], -1, -2)
    found[..., :3, :3] = rotation
    found[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, matrices[..., :3, 3])
    found[..., 3, 3] = 1.0
    return found


def matrices_of(positions: Array, quaternions: Array) -> Array:
    """Return (N, 4, 4) matrices of positions (N, 3) and quaternions (N, 4) x, y, z, w."""
    matrices = np.zeros((len(positions), 4, 4))
    matrices[:, :3, :3] = rotations(quaternions)
    matrices[:, :3, 3] = positions
    matrices[:, 3, 3] = 1.0
    return matrices


def between_poses(one: Array, two: Array, share: Array) -> Array:
    """Return poses between (N, 4, 4) matrices, at ``share`` (N,) of the way: positions linearly, rotations by slerp.

    Where one has a scale, a shear or a mirror, as the calibration of a picture has, it is number by number.
    """
    a, b = quaternions_of(one)[0], quaternions_of(two)[0]
    cosine = np.sum(a * b, axis=1)
    b = np.where((cosine < 0)[:, None], -b, b)  # of the two quaternions of a rotation, the nearer one
    # half of the chord gives small angles exactly, which arccos does not
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1))
    with np.errstate(all="ignore"):
        sine = np.sin(angle)
        tiny = sine < 1e-12
        first = np.where(tiny, 1 - share, np.sin((1 - share) * angle) / sine)
        second = np.where(tiny, share, np.sin(share * angle) / sine)
    positions = one[:, :3, 3] + share[:, None] * (two[:, :3, 3] - one[:, :3, 3])
    found = matrices_of(positions, first[:, None] * a + second[:, None] * b)
    odd = _stretch(one) | _stretch(two)
    found[odd] = one[odd] + share[odd, None, None] * (two[odd] - one[odd])
    # a sample itself stays as it is, to the last bit
    found[share == 0.0] = one[share == 0.0]
    found[share == 1.0] = two[share == 1.0]
    return found


def _stretch(matrices: Array) -> npt.NDArray[np.bool_]:
    """Which matrices (N, 4, 4) are more than a rotation and a translation: of scales, shears and mirrors."""
    turns = matrices[:, :3, :3]
    with np.errstate(all="ignore"):
        off = np.abs(np.einsum("nji,njk->nik", turns, turns) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    return np.asarray((off > _STRETCHED) | (np.linalg.det(turns) < 0))
