"""The complete review: it finds the planted errors and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from igtl_gateway.addons.review import Level, Material, Review, Thresholds, review_of
from igtl_gateway.addons.review.axes import BODY
from igtl_gateway.addons.review.model import Array
from igtl_gateway.addons.review.scene import DepthCloud, DepthScene
from igtl_gateway_lab.simulate import star_scene
from igtl_gateway_lab.simulate.star_camera import noise_sigma
from igtl_gateway_lab.simulate.star_tissue import PLANTED
from tests.addons.review.conftest import SEEDS
from tests.addons.review.sessions import SECOND, cloud_message, dome_clouds, entry, on_dome, plan_message, pose_message

_FIRST = np.stack([on_dome(x, -3.5) for x in (-3, 0, 3)])
_LAST = np.stack([on_dome(x, 3.5) for x in (-3, 0, 3)])


def _of(clouds: list[DepthCloud], *plans: tuple[Array, Array], limits: Thresholds | None = None) -> Review:
    material = Material()
    for cloud in clouds:
        material.take(entry("/cloud", cloud_message(cloud.points, cloud.stamp_ns), cloud.stamp_ns))
    for number, (first, last) in enumerate(plans, 1):
        material.take(entry("/plan", plan_message(first, last, number * SECOND), number * SECOND))
    return review_of(material, limits)


def _levels(review: Review) -> list[str]:
    return [stitch.level.value for stitch in review.last.stitches]


@pytest.fixture(scope="module")
def reviews(scenes: dict[int, DepthScene], stars: dict[int, star_scene.StarScene]) -> dict[int, Review]:
    """Seed → review of the measured plan, then of the true plan."""
    return {
        seed: _of(
            list(scenes[seed].clouds),
            (star.measured_plan.entry, star.measured_plan.exit),
            (star.plan.entry, star.plan.exit),
        )
        for seed, star in stars.items()
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_the_planted_stitches_are_wrong_and_no_others(seed: int, reviews: dict[int, Review]) -> None:
    stitches = reviews[seed].first.stitches
    assert tuple(stitch.number for stitch in stitches if stitch.level is Level.WRONG) == tuple(PLANTED)
    others = [stitch for stitch in stitches if stitch.number not in PLANTED]
    assert [stitch.reasons for stitch in others if stitch.level is not Level.OK] == []


@pytest.mark.parametrize("seed", SEEDS)
def test_the_distances_are_those_of_the_true_tissue(
    seed: int, reviews: dict[int, Review], stars: dict[int, star_scene.StarScene]
) -> None:
    """docs/evidence/review.md: the distance is right to 0.25 mm, independent of the error of the stitches."""
    star = stars[seed]
    for stitch, *truth in zip(reviews[seed].first.stitches, star.plan.entry, star.plan.exit, strict=True):
        for end, true in zip((stitch.entry, stitch.exit), truth, strict=True):
            assert end.distance_mm == pytest.approx((true[2] - end.position[2]) * 1000, abs=0.25)
    assert reviews[seed].last.wrong == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_noise_at_the_stitches_is_the_cameras(
    seed: int, reviews: dict[int, Review], scenes: dict[int, DepthScene], stars: dict[int, star_scene.StarScene]
) -> None:
    """docs/evidence/review.md: within 20 %."""
    view = stars[seed].cloud_view
    truth = noise_sigma(view.depth, view.facing).reshape(-1)
    for stitch in reviews[seed].last.stitches:
        for end in (stitch.entry, stitch.exit):
            x, y, z = end.position
            true_mm = 1000 * np.median(truth[scenes[seed].around(np.array([x, y]) / z, 0.0025 / z)])
            assert end.noise_mm == end.temporal_mm == pytest.approx(true_mm, rel=0.2)
            assert end.spatial_mm is not None
            if stitch.number not in PLANTED:  # the edge of a wet spot is not noise, but counts as spatial noise
                assert 0.7 * true_mm < end.spatial_mm < true_mm


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("off_mm", [-1.5, 1.5])
def test_any_stitch_that_is_moved_off_the_tissue_is_found(which: int, off_mm: float) -> None:
    moved = _LAST.copy()
    moved[which] *= 1 - off_mm / 1000 / moved[which, 2]
    review = _of(dome_clouds(6), (_FIRST, _LAST), (_FIRST, moved))
    assert [stitch.number for stitch in review.first.wrong] == []
    assert [stitch.number for stitch in review.last.wrong] == [which + 1]
    distance_mm = review.last.stitches[which].exit.distance_mm
    assert distance_mm == pytest.approx(off_mm, abs=0.15)
    assert [(change.number, change.before, change.after) for change in review.changes] == [
        (which + 1, Level.OK, Level.WRONG)
    ]
    assert review.changes[0].moved_mm == pytest.approx((0, 1.5), abs=0.05)


def test_wrong_readings_in_all_clouds_are_look_and_a_point_on_the_tissue_is_not_wrong() -> None:
    clouds = dome_clouds(6)
    for cloud in clouds:
        cloud.points[((cloud.points[..., :2] - _LAST[1, :2]) ** 2).sum(axis=-1) < 0.0016**2] *= 1.008
    review = _of(clouds, (_FIRST, _LAST))
    assert _levels(review) == ["ok", "look", "ok"]
    reading_mm = review.last.stitches[1].exit.reading_mm
    assert reading_mm == pytest.approx(-2.0, abs=0.2)


def test_wrong_readings_that_fill_the_window_are_reported() -> None:
    """The plan was computed from them, so plan and tissue agree: only the wider fit differs."""
    clouds = dome_clouds(6)
    for cloud in clouds:
        cloud.points[((cloud.points[..., :2] - _LAST[1, :2]) ** 2).sum(axis=-1) < 0.0035**2] *= 1.008
    lifted = _LAST.copy()
    lifted[1] *= 1.008
    stitch = _of(clouds, (_FIRST, lifted)).last.stitches[1]
    assert stitch.exit.distance_mm == pytest.approx(0, abs=0.3)
    assert stitch.exit.wider_mm == pytest.approx(2.0, abs=0.3)
    assert stitch.level is Level.LOOK
    assert any("with a wider window the tissue is" in reason for reason in stitch.reasons)


def test_the_figures_of_a_stitch_on_a_sphere() -> None:
    review = _of(dome_clouds(6), (_FIRST, _LAST))
    stitch = review.last.stitches[1]
    assert stitch.bite_length_mm == pytest.approx(7.0)
    sagitta_mm = 20 - np.sqrt(20**2 - 3.5**2)
    assert stitch.bite_depth_mm == pytest.approx(sagitta_mm, abs=0.05)
    assert stitch.entry.spacing_mm == pytest.approx(1000 * np.linalg.norm(_FIRST[1] - _FIRST[0]))
    pixels_mm2 = (700 / stitch.entry.position[2] / 1000) ** 2
    cosine = np.sqrt(20**2 - 3.5**2) / 20
    assert stitch.entry.density_mm2 == pytest.approx(pixels_mm2 * cosine, rel=0.05)
    assert stitch.entry.missing == 0.0
    assert review.tool == ""
    assert any("is not compared with the path of a tool" in note for note in review.notes)


def test_the_cloud_for_the_viewer() -> None:
    clouds = dome_clouds(4)
    for cloud in clouds:
        cloud.points[:2] = np.nan
    found = _of(clouds, (_FIRST, _LAST)).cloud
    assert (found.topic, found.frame_id, found.clouds, found.temporal) == ("/cloud", "camera", 4, True)
    assert found.stamps_ns == found.source_stamps_ns == (SECOND, 4 * SECOND)
    assert found.positions.shape == (58 * 80, 3)
    assert found.noise_mm.shape == (58 * 80,)
    assert found.positions.dtype == found.noise_mm.dtype == np.float32
    np.testing.assert_allclose(found.positions.reshape(58, 80, 3), clouds[0].points[2:], atol=0.001)
    assert np.nanmedian(found.noise_mm) == pytest.approx(0.2, rel=0.1)


def test_missing_pixels_and_sparse_clouds_are_look() -> None:
    clouds = dome_clouds(6)
    random = np.random.default_rng(5)
    for cloud in clouds:
        near = np.abs(cloud.points[..., 1] - _LAST[1, 1]) < 0.003
        cloud.points[near & (random.random(near.shape) < 0.8)] = np.nan
    stitch = _of(clouds, (_FIRST, _LAST)).last.stitches[1]
    assert stitch.level is Level.LOOK
    assert stitch.exit.missing == pytest.approx(0.8, abs=0.1)
    assert any("have no depth" in reason for reason in stitch.reasons)
    assert any("points/mm²" in reason for reason in stitch.reasons)


def test_a_stitch_outside_the_image_is_not_compared() -> None:
    far = _FIRST.copy()
    far[2, 0] = 0.1
    review = _of(dome_clouds(3), (far, _LAST), limits=replace(Thresholds(), spacing=1e6, bite=1e6))
    assert _levels(review) == ["ok", "ok", "look"]
    assert review.last.stitches[2].entry.distance_mm is None
    assert review.last.stitches[2].reasons == ("entry: too few points of tissue around it for a comparison",)


@pytest.mark.parametrize("wild", [(0.0, 0.0, 0.0), (0.0, 0.0, -0.25), (1e30, 0.0, 1e30)])
def test_an_implausible_point_affects_only_its_own_stitch(wild: tuple[float, float, float]) -> None:
    first = _FIRST.copy()
    first[0] = wild
    review = _of(dome_clouds(3), (first, _LAST), limits=replace(Thresholds(), spacing=1e40, bite=1e40))
    assert _levels(review) == ["look", "ok", "ok"]
    assert review.last.stitches[0].bite_depth_mm is None


def test_clouds_without_depth_have_no_figures() -> None:
    material = Material(plan="/plan")
    empty = np.full_like(dome_clouds(1)[0].points, np.nan)
    for stamp_ns in (1, 2, 3):
        material.take(entry("/cloud", cloud_message(empty, stamp_ns), stamp_ns))
    material.take(entry("/plan", plan_message(_FIRST, _LAST, 1), 1))
    review = review_of(material)
    assert _levels(review) == ["look"] * 3
    assert review.cloud.positions.shape == (0, 3)


def test_close_and_long_stitches_are_look() -> None:
    first = np.stack([on_dome(x, -3.5) for x in (-6, -3, 0, 0.8, 4)])
    last = np.stack([on_dome(x, y) for x, y in ((-6, 3.5), (-3, 3.5), (0, 3.5), (3, 3.5), (5.5, 8))])
    reasons = [stitch.reasons for stitch in _of(dome_clouds(4), (first, last)).last.stitches]
    assert not reasons[0]
    assert any("entry: spacing 0.8 mm" in text for text in reasons[3])
    assert any(text.startswith("bite 11") for text in reasons[4])


def test_added_and_removed_stitches_are_changes() -> None:
    review = _of(dome_clouds(3), (_FIRST, _LAST), (_FIRST[1:], _LAST[1:]))
    assert [(change.number, change.before, change.after) for change in review.changes] == [(1, Level.OK, None)]
    back = _of(dome_clouds(3), (_FIRST[1:], _LAST[1:]), (_FIRST, _LAST))
    assert [(change.number, change.before, change.after) for change in back.changes] == [(1, None, Level.OK)]


def test_the_path_of_the_tool_is_compared_in_the_frame_of_the_cloud() -> None:
    """The base is the parent of tool and camera; another frame moves too, but far away."""
    material = Material()
    for cloud in dome_clouds(4):
        material.take(entry("/cloud", cloud_message(cloud.points, cloud.stamp_ns), cloud.stamp_ns))
    material.take(entry("/plan", plan_message(_FIRST, _LAST, SECOND), SECOND))
    shift = np.array([0.5, 0.0, 0.4])
    material.take(entry("/camera_pose", pose_message("base", "camera", tuple(shift), SECOND), SECOND))
    above, deep = np.array([0, 0, -0.03]), np.array([0, 0, 0.0025])
    ways = np.stack([_FIRST[0] + above, _FIRST[0], on_dome(-3, 0) + deep, _LAST[0]])
    ways[2:, 0] += 0.0003
    for number, place in enumerate(ways, 1):
        stamp_ns = number * SECOND // 10
        material.take(entry("/tool", pose_message("base", "needle", tuple(place + shift), stamp_ns), stamp_ns))
        material.take(entry("/elbow", pose_message("base", "elbow", (number, 0, 0), stamp_ns), stamp_ns))
    review = review_of(material)
    assert review.tool == "needle"
    entered, left = (end.executed for end in (review.last.stitches[0].entry, review.last.stitches[0].exit))
    assert entered is not None
    assert left is not None
    assert entered.distance_mm == pytest.approx(0, abs=1e-6)
    assert left.distance_mm == pytest.approx(0.3, abs=0.02)
    assert (entered.reached, left.reached) == (True, True)
    assert entered.stamp_ns == 2 * SECOND // 10
    assert review.last.stitches[0].driven_depth_mm == pytest.approx(2.5, abs=0.15)
    other = review.last.stitches[1]
    assert other.entry.executed is not None
    assert not other.entry.executed.reached
    assert other.driven_depth_mm is None


def test_few_clouds_and_motion_are_noted() -> None:
    assert any("only 1 cloud:" in note for note in _of(dome_clouds(1), (_FIRST, _LAST)).notes)
    clouds = dome_clouds(4)
    for number, cloud in enumerate(clouds):
        cloud.points[...] *= 1 + 0.004 * number / 0.25
    assert any("moved by +12" in note for note in _of(clouds, (_FIRST, _LAST)).notes)
    assert not any("moved" in note or "only" in note for note in _of(dome_clouds(4), (_FIRST, _LAST)).notes)


def test_an_unorganised_cloud_is_reviewed_without_noise_and_missing_pixels() -> None:
    points = dome_clouds(1)[0].points.reshape(1, -1, 3)
    moved = _LAST.copy()
    moved[1, 2] += 0.002
    review = _of([DepthCloud("/cloud", "camera", 1, 1, points)], (_FIRST, moved))
    assert [stitch.number for stitch in review.last.wrong] == [2]
    end = review.last.stitches[0].entry
    assert (end.noise_mm, end.missing) == (None, None)
    assert end.density_mm2 is not None
    assert not review.cloud.temporal


def test_quantised_depth_with_noise_is_look() -> None:
    """σ 0.4 mm in steps of 1 mm: most readings equal the one before, and the true noise is 0.49 mm."""
    clouds = dome_clouds(8, sigma=0.0004)
    for cloud in clouds:
        cloud.points[...] *= (np.round(cloud.points[..., 2] * 1000) / 1000 / cloud.points[..., 2])[..., None]
    review = _of(clouds, (_FIRST, _LAST))
    assert _levels(review) == ["look"] * 3
    for stitch in review.last.stitches:
        for end in (stitch.entry, stitch.exit):
            assert end.noise_mm == pytest.approx(0.494, rel=0.15)
    assert review.cloud.step_mm == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("sigma_mm", [0.34, 0.8])
def test_the_noise_of_lifted_points_is_part_of_their_error(sigma_mm: float) -> None:
    clouds = dome_clouds(8, sigma=sigma_mm / 1000)
    raw = clouds[3].points.astype(np.float32).astype(np.float64)
    columns = np.arange(12, 72, 6)
    first, last = raw[18, columns], raw[42, columns]
    review = _of(clouds, (first, last))
    ends = [end for stitch in review.last.stitches for end in (stitch.entry, stitch.exit)]
    assert all(end.lifted for end in ends)
    assert review.last.wrong == ()
    assert np.median([end.error_mm for end in ends]) == pytest.approx(sigma_mm, rel=0.3)
    last = last.copy()
    last[4] *= 1 + 0.004 / last[4, 2]
    assert [stitch.number for stitch in _of(clouds, (first[3:6], last[3:6])).last.wrong] == [2]


def test_a_plan_from_a_cloud_outside_the_file_has_a_scatter() -> None:
    raw = dome_clouds(9, sigma=0.0008)[8].points
    columns = np.arange(12, 72, 6)
    review = _of(dome_clouds(8, sigma=0.0008), (raw[18, columns], raw[42, columns]))
    assert review.last.wrong == ()
    assert all((stitch.entry.scatter_mm or 0) > 0.3 and not stitch.entry.lifted for stitch in review.last.stitches)


@pytest.mark.parametrize("organised", [True, False])
def test_an_x_forward_cloud_is_reviewed_along_its_depth_and_noted(organised: bool) -> None:
    clouds = dome_clouds(4)
    moved = _LAST.copy()
    moved[1] *= 1 - 0.0025 / moved[1, 2]
    turned = [replace(cloud, points=BODY.from_optical(cloud.points), frame_id="camera_link") for cloud in clouds]
    if not organised:
        turned = [replace(cloud, points=cloud.points.reshape(1, -1, 3)) for cloud in turned]
    material = Material()
    for cloud in turned:
        message = cloud_message(cloud.points, cloud.stamp_ns, "camera_link")
        material.take(entry("/cloud", message, cloud.stamp_ns))
    plan = plan_message(BODY.from_optical(_FIRST), BODY.from_optical(moved), SECOND, "camera_link")
    material.take(entry("/plan", plan, SECOND))
    review = review_of(material)
    assert [stitch.number for stitch in review.last.wrong] == [2]
    assert any("x forward" in note for note in review.notes)
    np.testing.assert_allclose(review.last.stitches[0].entry.position, BODY.from_optical(_FIRST)[0])
    assert np.median(review.cloud.positions[:, 0]) == pytest.approx(0.25, abs=0.01)
