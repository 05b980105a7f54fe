"""Surfaces of volumes, compared with spheres, whose surface is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from igtl_gateway_lab.simulate.brain_surface import TriangleMesh, extract_surface, procedural_brain, resampled, smoothed

RADIUS = 9.0
MIDDLE = np.array([12.0, 14.0, 11.0])


def ball() -> NDArray[np.float64]:
    """How deep inside a sphere each voxel is."""
    place = np.stack(np.meshgrid(*(np.arange(n) for n in (25, 28, 23)), indexing="ij"), axis=-1)
    return np.asarray(RADIUS - np.sqrt(((place - MIDDLE) ** 2).sum(axis=-1)))


def volume_of(surface: TriangleMesh) -> float:
    """By the divergence theorem: positive where faces look outwards."""
    a, b, c = (surface.points[surface.faces[:, corner]] for corner in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def edges_of(surface: TriangleMesh) -> NDArray[np.int64]:
    """How many faces each edge has."""
    faces = surface.faces
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.asarray(np.unique(edges, axis=0, return_counts=True)[1])


def test_a_sphere_is_where_it_is() -> None:
    surface = extract_surface(ball(), 0.0)
    off = np.sqrt(((surface.points - MIDDLE) ** 2).sum(axis=1)) - RADIUS
    assert np.abs(off).max() < 0.06
    assert volume_of(surface) == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.02)


def test_a_sphere_is_closed_and_of_one_piece() -> None:
    surface = extract_surface(ball(), 0.0)
    assert set(edges_of(surface)) == {2}
    # Euler: corners − edges + faces of a sphere
    assert len(surface.points) - len(edges_of(surface)) + len(surface.faces) == 2


def test_what_reaches_the_border_is_closed_there() -> None:
    surface = extract_surface(np.ones((14, 15, 16)), 0.5)
    assert set(edges_of(surface)) == {2}
    assert volume_of(surface) == pytest.approx(14 * 15 * 16, rel=0.1)


def test_nothing_has_no_surface() -> None:
    surface = extract_surface(np.zeros((4, 4, 4)), 0.5)
    assert surface.points.shape == surface.faces.shape == (0, 3)


def test_placed_surfaces_face_outwards_in_mirrored_volumes_too() -> None:
    surface = extract_surface(ball(), 0.0)
    mirrored = np.diag([2.0, -1.0, 1.0])
    placed = surface.placed(mirrored, np.array([5.0, 0.0, 0.0]))
    assert volume_of(placed) == pytest.approx(2 * volume_of(surface))
    assert placed.points[7] == pytest.approx(surface.points[7] * [2, -1, 1] + [5, 0, 0])


def test_unwelded_is_the_same_surface_with_three_points_for_each_face() -> None:
    surface = extract_surface(ball(), 0.0)
    loose = surface.unwelded()
    assert loose.points.shape == (3 * len(surface.faces), 3)
    assert (loose.points[loose.faces] == surface.points[surface.faces]).all()


def test_smoothed_is_a_binomial_mean_in_whole_numbers() -> None:
    voxels = np.zeros((5, 5, 5), np.uint8)
    voxels[2, 2, 2] = 255
    assert smoothed(voxels)[2, 2].tolist() == [0, 255 * 4, 255 * 8, 255 * 4, 0]
    assert (smoothed(np.full((3, 4, 5), 255, np.uint8)) == 255 * 64).all(), "nor does the largest value overflow"


def test_resampled_keeps_straight_lines() -> None:
    i, j, k = np.meshgrid(np.arange(5), np.arange(4), np.arange(6), indexing="ij")
    field = resampled(2.0 * i + 3 * j - k, 0.75)
    assert field.shape == (6, 5, 7)
    assert field[2, 3, 4] == pytest.approx(0.75 * (2 * 2 + 3 * 3 - 4))
    assert field[5, 4, 6] == pytest.approx(0.75 * (2 * 5 + 3 * 4 - 6))


def test_the_procedural_brain_is_a_folded_body_of_a_brains_size() -> None:
    brain = procedural_brain(5.0)
    litres = volume_of(brain) / 1e6
    assert 0.9 < litres < 1.4
    assert (edges_of(brain) % 2 == 0).all(), "closed"
    a, b, c = (brain.points[brain.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    area = float(np.sqrt((normal * normal).sum(axis=1)).sum() / 2)
    smooth = 4.836 * (litres * 1e6) ** (2 / 3)  # of a sphere of that volume
    assert area > 1.5 * smooth
    right, left = (brain.points[brain.points[:, 0] * side > 5] for side in (1, -1))
    assert 0.8 < len(right) / len(left) < 1.25
