"""MR volumes for the scenarios: Colin27 from a NIfTI file, or a synthetic head.

Debian packs Colin27 (``ch2``, ``ch2bet``) as ``mricron-data``, and ``tools/setup.sh mri`` fetches it.  Without it the
scenarios use ``synthetic_head``: layered ellipsoids with folds, **not the anatomy of a person**, in the same place and
orientation, so that a plan for one head fits the other.  Its voxels are integers: rounding removes the last bits of the
sines, and the voxels are the same on every machine.

Coordinates are millimetres, RAS; arrays of voxels are (k, j, i), as they are in files and on the wire.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted.files import size_of
from igtl_gateway.wire.image import LITTLE_ENDIAN, RAS, SCALARS, Image
from igtl_gateway_lab.simulate.star_numbers import Array

#: Folder with ``ch2.nii.gz`` and ``ch2bet.nii.gz``, or one NIfTI file for both; or ``synthetic``.
VARIABLE = "IGTL_GATEWAY_MRI"
SYNTHETIC = "synthetic"
HEAD, BRAIN = "ch2", "ch2bet"  #: Colin27 with and without all that surrounds the brain
_INSTALLED = Path("/usr/share/mricron/templates")

#: The box that Colin27 fills, mm RAS: the outer corners of its first and its last voxel.
_LOW, _HIGH = np.array([-90.5, -125.5, -71.5]), np.array([90.5, 91.5, 109.5])


@dataclass(frozen=True, slots=True, eq=False)
class MrVolume:
    """A volume with its place in the patient.

    Attributes:
        voxels: (k, j, i) numbers.
        affine: (3, 4): indices i, j, k of a voxel → its centre, mm RAS.
        source: where it comes from, for people.
    """

    voxels: npt.NDArray[Any]
    affine: Array
    source: str

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along i, j, k."""
        k, j, i = self.voxels.shape
        return i, j, k

    @property
    def image(self) -> Image:
        """As IMAGE, whose position is that of the centre."""
        a, half = self.affine, [(count - 1) / 2 for count in self.size]
        centre = [a[row, 0] * half[0] + a[row, 1] * half[1] + a[row, 2] * half[2] + a[row, 3] for row in range(3)]
        matrix = [*a[:, 0], *a[:, 1], *a[:, 2], *centre]
        kind = next(number for number, name in SCALARS.items() if self.voxels.dtype.str[1:] == name)
        voxels = self.voxels.astype(self.voxels.dtype.newbyteorder("<"), copy=False)
        return Image(self.size, kind, voxels.tobytes(), 1, LITTLE_ENDIAN, RAS, tuple(float(x) for x in matrix))


def head_volume(name: str = HEAD, spacing_mm: float = 2.8) -> MrVolume:
    """Colin27 where this machine has it, the head made of formulae, of that spacing, where not.

    ``$IGTL_GATEWAY_MRI`` goes before all, see ``VARIABLE``.  Raises ConfigError where what it names cannot be read.
    """
    path = find_volume(name)
    return read_nifti_volume(path) if path else synthetic_head(spacing_mm, brain_only=name == BRAIN)


def find_volume(name: str = HEAD) -> Path | None:
    """The file ``name.nii.gz`` of Colin27, or None.  Raises ConfigError where the variable names nothing."""
    file = f"{name}.nii.gz"
    if wanted := os.environ.get(VARIABLE):
        if wanted == SYNTHETIC:
            return None
        path = Path(wanted) / file if Path(wanted).is_dir() else Path(wanted)
        if not path.is_file():
            raise ConfigError(f"${VARIABLE}: found {wanted}, expected a folder with {file}, a file or {SYNTHETIC}")
        return path
    fetched = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "igtl_gateway" / "mri"
    return next((folder / file for folder in (_INSTALLED, fetched) if (folder / file).is_file()), None)


# -- NIfTI ------------------------------------------------------------------------------------------------------------

#: A voxel count above this is a broken header: 2 GB of the largest type.
_MAX_VOXELS = 1 << 28


def read_nifti_volume(path: Path) -> MrVolume:
    """Read a volume from a NIfTI file, ``.nii`` or ``.nii.gz``, with nibabel; scaled voxels are float32.

    The place is that of nibabel: sform, else qform, else centred.  Raises ConfigError for an unreadable file, or one
    that does not contain exactly one 3-D volume.
    """
    import nibabel

    try:
        size_of(path)  # nibabel would wait for a FIFO
        file = nibabel.squeeze_image(nibabel.load(path, mmap=False))
        affine = np.asarray(file.affine, np.float64)[:3]
        _check(len(file.shape) == 3, f"dimensions: found {file.shape}, expected one volume of 3 dimensions")
        _check(
            0 < math.prod(file.shape) <= _MAX_VOXELS, f"size: found {file.shape}, expected 1 to {_MAX_VOXELS} voxels"
        )
        _check(
            bool(np.isfinite(affine).all()) and np.linalg.det(affine[:, :3]) != 0,
            f"place: found {affine.tolist()}, expected finite axes that are not in one plane",
        )
        voxels = np.asanyarray(file.dataobj).T
        if voxels.dtype != file.get_data_dtype():
            voxels = voxels.astype(np.float32)
        kinds = sorted(SCALARS.values())
        _check(voxels.dtype.str[1:] in kinds, f"data type: found {voxels.dtype}, expected one of {kinds}")
    except Exception as error:  # whatever nibabel raises
        raise ConfigError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    return MrVolume(voxels, affine, path.name)


def _check(good: bool, fault: str) -> None:
    if not good:
        raise ValueError(fault)


# -- A head made of formulae ------------------------------------------------------------------------------------------

_CENTRE = np.array([0.0, -18.0, 6.0])
_SCALP = np.array([77.0, 98.0, 92.0])  #: half axes of the ellipsoid, mm
_SKULL_MM, _CSF_MM, _HULL_MM = 5.0, 9.0, 11.0  #: below the scalp; the hull is that of the brain
_GREY_MM = 3.2  #: thickness of the cortex
_FOLD_MM = 24.0  #: from one fold to the next but one
_SULCUS_MM, _SULCUS_DEPTH_MM = 1.8, 15.0  #: half width of a fold, and how deep it goes
_EDGE_MM = 1.2  #: half width of the borders between tissues: a voxel that lies in both is in between

#: What a T1 picture shows of each.
_FAT, _BONE, _CSF, _GREY, _WHITE = 190.0, 22.0, 34.0, 112.0, 158.0
_LESION_VALUE = 226.0
LESION = np.array([36.0, -48.0, 20.0])  #: centre of the lesion that the plans are drawn around
_LESION_MM = 11.0
_VENTRICLES = ((11.0, -12.0, 18.0), (6.0, 28.0, 9.0))  #: centre (of the right one) and half axes
_EYES = ((31.0, 58.0, -34.0), 12.0)
_NOSE = ((0.0, 68.0, -42.0), (13.0, 22.0, 20.0))


def synthetic_head(spacing_mm: float = 2.8, *, brain_only: bool = False) -> MrVolume:
    """A head that was made up: scalp, skull, a folded brain with ventricles, eyes, and a bright lesion on the right.

    ``brain_only`` leaves the brain alone, as ``ch2bet`` does.  Raises ConfigError for a spacing below 0.4 mm (a
    volume of 100 MB and more) or above 20.
    """
    if not 0.4 <= spacing_mm <= 20:
        raise ConfigError(f"spacing of the synthetic head: found {spacing_mm} mm, expected 0.4 … 20")
    size = np.floor((_HIGH - _LOW) / spacing_mm + 1e-9).astype(int)
    origin = _LOW + spacing_mm / 2
    x, y, z = (origin[axis] + spacing_mm * np.arange(size[axis]) for axis in range(3))
    voxels = np.empty(size[::-1], np.uint8)
    for k, height in enumerate(z):  # a slice at a time: the whole in float64 would take a gigabyte
        voxels[k] = np.rint(_tissue(x[None, :], y[:, None], height, brain_only))
    affine = np.zeros((3, 4))
    affine[:, :3], affine[:, 3] = np.eye(3) * spacing_mm, origin
    return MrVolume(voxels, affine, f"synthetic {'brain' if brain_only else 'head'}, {spacing_mm:g} mm")


def _tissue(x: Array, y: Array, z: float, brain_only: bool) -> Array:
    """Grey values of the points of a plane."""
    depth = _depth(x, y, z, _CENTRE, _SCALP)  # below the scalp
    inner = np.minimum(depth, 0.8 * (z + 66.0) - 0.25 * (y + 18.0))  # the skull is flat at its base
    hull = inner - _HULL_MM
    fold = _folds(x, y, z)
    brain = np.minimum(hull, fold - np.minimum(_SULCUS_MM, 0.35 * (_SULCUS_DEPTH_MM - hull)))
    brain = np.where(z > -5.0, np.minimum(brain, np.abs(x) - 2.0 + np.maximum(hull - 30.0, 0.0)), brain)  # the fissure
    white = brain - _GREY_MM
    value = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    if not brain_only:
        value = _over(value, _FAT, np.maximum(depth, _depth(x, y, z, np.array(_NOSE[0]), np.array(_NOSE[1]))))
        value = _over(value, _BONE, inner - _SKULL_MM)
        value = _over(value, _CSF, inner - _CSF_MM)
    value = _over(value, _GREY, brain)
    value = _over(value, _WHITE, white)
    centre, axes = _VENTRICLES
    for side in (1.0, -1.0):
        value = _over(value, _CSF, _depth(x, y, z, np.array(centre) * (side, 1, 1), np.array(axes)))
        if not brain_only:
            eye, radius = _EYES
            value = _over(value, _CSF + 12.0, _depth(x, y, z, np.array(eye) * (side, 1, 1), np.full(3, radius)))
    lesion = _depth(x, y, z, LESION, np.full(3, _LESION_MM))
    return _over(value, _LESION_VALUE, lesion + 0.5 * np.sin(x / 3.0) * np.sin(y / 4.0))


def _depth(x: Array, y: Array, z: float, centre: Array, axes: Array) -> Array:
    """How deep a point lies in an ellipsoid, nearly, in mm; below 0 outside."""
    u, v, w = (x - centre[0]) / axes[0], (y - centre[1]) / axes[1], (z - centre[2]) / axes[2]
    level = np.sqrt(u * u + v * v + w * w)
    # the gradient of the level is the density of its surfaces
    slope = np.sqrt((u / axes[0]) ** 2 + (v / axes[1]) ** 2 + (w / axes[2]) ** 2)
    return np.asarray(level * (1.0 - level) / np.maximum(slope, 1e-6))


def _folds(x: Array, y: Array, z: float) -> Array:
    """How far from the middle of the next fold, nearly, in mm: from a gyroid, bent so that no two are alike."""
    turns = 2 * np.pi / _FOLD_MM
    u = turns * (np.abs(x) + 4.0 * np.sin(y / 17.0) + 3.0 * np.sin(z / 13.0))
    v = turns * (y + 5.0 * np.sin(z / 19.0 + 1.0) + 3.0 * np.sin(x / 23.0))
    w = turns * (z + 4.0 * np.sin(x / 15.0 + 2.0) + 3.0 * np.sin(y / 11.0))
    gyroid = np.sin(u) * np.cos(v) + np.sin(v) * np.cos(w) + np.sin(w) * np.cos(u)
    return np.asarray(np.abs(gyroid) * (_FOLD_MM / 9.0))  # its gradient there is about 1.5 · turns


def _over(below: Array, value: float, depth: Array) -> Array:
    """``value`` painted over where ``depth`` (mm) is above 0, with a soft border."""
    part = np.clip(depth / (2 * _EDGE_MM) + 0.5, 0.0, 1.0)
    return np.asarray(below + (value - below) * part)
