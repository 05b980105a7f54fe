"""The STAR scene against its own truth: views, the two plans, what the sensors make of it."""

from __future__ import annotations

import numpy as np
import pytest

from igtl_gateway_lab.simulate.star_arm import CYCLE_S, RETRACT_M, SHAFT, held, to_camera
from igtl_gateway_lab.simulate.star_camera import IMAGE_CAMERA, CloudFrame, View, noise_sigma
from igtl_gateway_lab.simulate.star_numbers import Array, Mask
from igtl_gateway_lab.simulate.star_scene import StarScene
from igtl_gateway_lab.simulate.star_tissue import (
    FOCUS_M,
    GLINT_ERROR_M,
    GLINT_STITCH,
    PLANTED,
    SPOT_RADIUS_M,
    STITCHES,
    WET_ERROR_M,
    WET_STITCH,
    surface_distance,
)
from tests.lab.simulate.star_truth import BEGIN_S, length


def test_another_seed_gives_other_noise() -> None:
    assert not np.array_equal(StarScene(1).detected_markers(0), StarScene(2).detected_markers(0))


@pytest.mark.parametrize("camera", ["cloud_view", "image_view"])
def test_views_lie_on_the_true_surface(scene: StarScene, camera: str) -> None:
    view: View = getattr(scene, camera)
    assert np.abs(surface_distance(view.rays * view.depth[..., None])).max() < 1e-6
    assert abs(view.depth.min() - FOCUS_M) < 0.002
    width = view.rays[0, -1, 0] - view.rays[0, 0, 0]
    assert width * FOCUS_M == pytest.approx(0.070, rel=0.01)


def test_the_measured_plan_misses_the_tissue_at_the_planted_stitches_and_nowhere_else(scene: StarScene) -> None:
    plan = scene.measured_plan
    miss = np.maximum(length(plan.entry - scene.plan.entry), length(plan.exit - scene.plan.exit))
    assert [int(number) + 1 for number in np.flatnonzero(miss > 0.0005)] == list(PLANTED)
    deeper = (plan.entry - scene.plan.entry)[GLINT_STITCH, 2], (plan.exit - scene.plan.exit)[WET_STITCH, 2]
    np.testing.assert_allclose(deeper, (GLINT_ERROR_M, WET_ERROR_M), atol=0.0003)
    # drawn in the picture: the miss is along the ray, where the picture cannot show it
    for row, truth in ((plan.entry, scene.plan.entry), (plan.exit, scene.plan.exit)):
        np.testing.assert_allclose(IMAGE_CAMERA.project(row), IMAGE_CAMERA.project(truth), atol=0.05)


def test_the_glint_is_in_the_first_shot_alone_and_the_wet_spot_in_all(scene: StarScene) -> None:
    spots = (scene.plan.entry[GLINT_STITCH], scene.plan.exit[WET_STITCH])
    found = []
    for number in range(3):
        frame = scene.cloud(number, scene.rest, SHAFT)
        error = frame.points[..., 2] - frame.truth[..., 2]
        found.append([float(np.nanmedian(error[length(frame.truth - spot) < SPOT_RADIUS_M])) for spot in spots])
    np.testing.assert_allclose(found, [[-0.002, 0.002], [0, 0.002], [0, 0.002]], atol=0.0002)
    first, later = (scene.image(number, scene.rest, SHAFT).astype(int) for number in (0, 1))
    column, row = np.rint(IMAGE_CAMERA.project(spots[0])).astype(int)
    assert (first - later)[row, column, 1:].min() > 40  # it shines white on red


def dry(scene: StarScene, frame: CloudFrame) -> Mask:
    """All but the two spots, which deliberately give wrong values."""
    spots = (scene.plan.exit[WET_STITCH], scene.plan.entry[GLINT_STITCH])
    return np.asarray(np.all([length(frame.truth - spot) > SPOT_RADIUS_M for spot in spots], axis=0))


@pytest.fixture(scope="module")
def depth_errors(scene: StarScene, frames: list[CloudFrame]) -> tuple[Array, Array, Array]:
    """Depth error, true depth and facing of every measured tissue point, without outliers and the wet spot."""
    error, depth, facing = [], [], []
    for frame in frames:
        use = np.isfinite(frame.points[..., 2]) & ~frame.outlier & ~frame.tool & dry(scene, frame)
        error.append((frame.points[..., 2] - frame.truth[..., 2])[use])
        depth.append(frame.truth[..., 2][use])
        facing.append(scene.cloud_view.facing[use])
    return np.concatenate(error), np.concatenate(depth), np.concatenate(facing)


def test_depth_noise_follows_its_model(depth_errors: tuple[Array, Array, Array]) -> None:
    error, depth, facing = depth_errors
    scaled = error / noise_sigma(depth, facing)
    assert abs(scaled.mean()) < 0.02
    assert scaled.std() == pytest.approx(1, abs=0.02)
    at_focus = (np.abs(depth - FOCUS_M) < 0.002) & (facing > 0.97)
    assert error[at_focus].std() == pytest.approx(0.00018, rel=0.05)


def test_depth_noise_grows_with_depth_and_towards_grazing(depth_errors: tuple[Array, Array, Array]) -> None:
    error, depth, facing = depth_errors
    towards = facing > 0.95
    near, far = error[towards & (depth < 0.252)].std(), error[towards & (depth > 0.285)].std()
    assert far / near == pytest.approx((0.29 / 0.251) ** 2, rel=0.1)
    level = np.abs(depth - 0.262) < 0.003  # flanks of the main tube, tops of the loops behind it
    steep, flat = error[level & (facing < 0.5)].std(), error[level & (facing > 0.9)].std()
    assert steep > 1.4 * flat


def test_depth_noise_is_alike_between_neighbours(scene: StarScene, frames: list[CloudFrame]) -> None:
    def likeness(pixels: int) -> float:
        products = []
        for frame in frames:
            sigma = noise_sigma(scene.cloud_view.depth, scene.cloud_view.facing)
            error = (frame.points[..., 2] - frame.truth[..., 2]) / sigma
            error[frame.outlier | frame.tool | ~dry(scene, frame)] = np.nan
            products.append(error[:, :-pixels] * error[:, pixels:])
        return float(np.nanmean(products))

    assert 0.2 < likeness(1) < 0.5
    assert abs(likeness(40)) < 0.05


def test_what_the_camera_loses(scene: StarScene, frames: list[CloudFrame]) -> None:
    view = scene.cloud_view
    lost = np.mean([np.isnan(frame.points[..., 0]) & ~frame.tool for frame in frames], axis=0)
    clear = (view.facing > 0.5) & (view.gloss < 0.5) & (view.depth < 0.268)
    assert 0.005 < lost[clear].mean() < 0.04
    for frame in frames:
        assert np.isnan(frame.points[(view.facing < 0.25) & ~frame.tool]).all()
        assert np.isnan(frame.points[(view.gloss > 0.7) & ~frame.tool]).all()
    assert lost[view.depth > 0.285].mean() > 0.3  # blurred
    assert 0.001 < np.mean([frame.outlier for frame in frames]) < 0.003


def test_tool_covers_part_of_the_later_clouds_only(frames: list[CloudFrame]) -> None:
    assert not frames[0].tool.any()  # waits outside the picture
    assert frames[3].tool.sum() > 500
    shown = frames[3].tool & np.isfinite(frames[3].points[..., 2]) & ~frames[3].outlier
    np.testing.assert_allclose(frames[3].points[shown][:, 2], frames[3].truth[shown][:, 2], atol=0.002)


def test_pulled_needle_leaves_the_tissue(scene: StarScene) -> None:
    ends = np.array([BEGIN_S + CYCLE_S * (stitch + 1) for stitch in range(STITCHES)])
    tips = to_camera(scene.tool(ends, scene.plan, BEGIN_S).position)
    np.testing.assert_allclose(length(tips - scene.plan.exit), RETRACT_M, atol=1e-4)
    assert surface_distance(tips).min() > 0.005


def test_the_pose_of_the_tool_tells_where_the_needle_is_and_points(scene: StarScene) -> None:
    path = scene.tool(np.array([0.0]), scene.plan)
    tip, shaft = held(tuple(path.position[0]), tuple(path.rotation[0]))
    np.testing.assert_allclose(tip, scene.rest, atol=5e-5)
    np.testing.assert_allclose(shaft, SHAFT, atol=1e-3)
    assert length(shaft) == pytest.approx(1)
