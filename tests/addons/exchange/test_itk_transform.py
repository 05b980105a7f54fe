"""Transforms of ITK: each kind with SimpleITK as referee, and files that are damaged, huge or of other kinds."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from igtl_gateway.addons.exchange.itk_transform import read_transform, to_parent
from igtl_gateway.base.errors import DamagedRecording, GatewayError, LimitExceeded, UnsupportedRecording
from tests.addons.exchange.itk import sitk
from tests.tables import table

POINTS = [(0.0, 0.0, 0.0), (10.0, -20.0, 30.0), (-7.5, 3.25, 111.0)]
CENTRE = (3.0, -4.0, 5.0)
HEAD = "#Insight Transform File V1.0\n#Transform 0\n"
AFFINE = f"{HEAD}Transform: AffineTransform_double_3_3\nParameters: 1 0 0 0 1 0 0 0 1 5 6 7\nFixedParameters: 0 0 0\n"


def kinds() -> dict[str, Any]:
    """A transform of each kind that SimpleITK makes."""
    module = sitk()
    affine = module.AffineTransform(3)
    affine.SetMatrix((0.9, -0.2, 0.3, 0.1, 1.2, -0.4, -0.25, 0.5, 0.8))
    affine.SetTranslation((1, 2, 3))
    euler = module.Euler3DTransform(CENTRE, 0.1, -0.4, 0.7, (1, 2, 3))
    other = module.Euler3DTransform(CENTRE, 0.1, -0.4, 0.7, (1, 2, 3))
    other.SetComputeZYX(True)
    versor = (0.1, -0.2, 0.3, 0.9273618495495703)
    both = module.CompositeTransform(3)
    both.AddTransform(affine)
    both.AddTransform(euler)
    both.AddTransform(module.ScaleTransform(3, (1.5, 0.5, 2)))
    return {
        "affine": affine,
        "euler": euler,
        "euler zyx": other,
        "versor": module.VersorTransform(versor, CENTRE),
        "rigid": module.VersorRigid3DTransform(versor, (1, 2, 3), CENTRE),
        "similarity": module.Similarity3DTransform(1.5, versor, (1, 2, 3), CENTRE),
        "scale": module.ScaleTransform(3, (1.5, 0.5, 2)),
        "scale versor": module.ScaleVersor3DTransform((1.5, 0.5, 2), versor, (1, 2, 3), CENTRE),
        "skew": module.ScaleSkewVersor3DTransform(
            (1.5, 0.5, 2), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6), versor, (1, 2, 3), CENTRE
        ),
        "translation": module.TranslationTransform(3, (1, 2, 3)),
        "identity": module.Transform(3, module.sitkIdentity),
        "composite": both,
    }


@table(
    "kind",
    [
        *("affine", "euler", "euler zyx", "versor", "rigid", "similarity", "scale", "scale versor"),
        *("skew", "translation", "identity", "composite"),
    ],
)
def test_each_kind_moves_points_as_itk_does(tmp_path: Path, kind: str) -> None:
    module, transform = sitk(), kinds()[kind]
    for suffix in (".tfm", ".h5", *((".mat",) if kind not in ("composite", "identity") else ())):
        path = tmp_path / f"{kind}{suffix}"
        module.WriteTransform(transform, str(path))
        _, matrix = read_transform(path)
        for point in POINTS:
            assert np.allclose((matrix @ [*point, 1.0])[:3], transform.TransformPoint(point), atol=1e-9), suffix


def test_the_inverse_is_in_ras() -> None:
    matrix = np.array([[0.0, 2, 0, 1], [-2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    signs = np.diag([-1.0, -1, 1, 1])
    assert np.allclose(to_parent(matrix, "t"), np.linalg.inv(signs @ matrix @ signs)[:3])


@pytest.mark.parametrize(
    ("text", "error", "match"),
    [
        (HEAD, DamagedRecording, "found no transform, expected one"),
        (AFFINE.replace("5 6 7", "5 6"), DamagedRecording, "found 11 parameters, expected 12"),
        (AFFINE.replace("5 6 7", "5 6 nan"), DamagedRecording, "found a number that is not finite"),
        (AFFINE.replace("5 6 7", "5 6 x"), DamagedRecording, "line 4: Parameters: .*expected numbers"),
        (AFFINE.replace("Parameters: 1", "Parameter: 1"), DamagedRecording, "line 4: found 'Parameter: 1"),
        (AFFINE.replace("0 0 0\n", "0 0\n"), DamagedRecording, "found 2 fixed parameters, expected 3"),
        (AFFINE.replace("double_3_3", "double_2_2"), UnsupportedRecording, "of 2 dimensions, expected 3"),
        (AFFINE.replace("Affine", "Wavelet"), UnsupportedRecording, "found WaveletTransform, expected one of Affine"),
        (AFFINE.replace("AffineT", "BSplineT"), UnsupportedRecording, "found a B-spline .*expected a linear transform"),
        (AFFINE.replace("V1.0", "V9.9"), UnsupportedRecording, "line 1: found '#Insight .* V9.9', expected .* V1.0'"),
        (AFFINE + AFFINE[len(HEAD) :], UnsupportedRecording, "found 2 transforms, expected one, or one Composite"),
    ],
)
def test_a_bad_text_is_refused_with_its_place(tmp_path: Path, text: str, error: type[Exception], match: str) -> None:
    path = tmp_path / "bad.tfm"
    path.write_text(text)
    with pytest.raises(error, match=match) as raised:
        read_transform(path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)


def test_a_long_line_of_numbers_meets_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "long.tfm"
    path.write_text(AFFINE.replace("5 6 7", "5\t6\t" + "7\t" * 300_000))
    with pytest.raises(LimitExceeded, match="line 4: Parameters: characters"):
        read_transform(path)


def test_a_matrix_without_an_inverse_is_refused() -> None:
    with pytest.raises(DamagedRecording, match="without an inverse"):
        to_parent(np.diag([1.0, 1.0, 0.0, 1.0]), "t")


def test_a_matlab_file_with_wrong_counts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.mat"
    name = b"AffineTransform_double_3_3\0"
    head = struct.pack("<5i", 0, 1 << 30, 1 << 30, 0, len(name)) + name
    path.write_bytes(head + bytes(96))
    with pytest.raises(DamagedRecording, match="expected 1073741824 by 1073741824 numbers"):
        read_transform(path)


@pytest.mark.parametrize("suffix", [".h5", ".mat", ".tfm"])
def test_any_cut_and_changed_file_is_read_or_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"t{suffix}"
    sitk().WriteTransform(kinds()["composite" if suffix != ".mat" else "rigid"], str(path))
    whole = path.read_bytes()
    random = np.random.default_rng(1)
    for number in range(300):
        data = bytearray(whole[: random.integers(len(whole))] if number % 3 == 0 else whole)
        for _ in range(number % 4):
            if data:
                data[random.integers(len(data))] = random.integers(256)
        path.write_bytes(data)
        try:
            _, matrix = read_transform(path)
            to_parent(matrix, "t")
        except GatewayError as error:
            assert "found" in str(error), error
