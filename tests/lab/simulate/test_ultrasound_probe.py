"""The hand that sweeps, and the tracker that looks at it."""

from __future__ import annotations

import numpy as np

from igtl_gateway_lab.simulate.registration import Rigid
from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.ultrasound_phantom import LENGTH_MM
from igtl_gateway_lab.simulate.ultrasound_probe import IMAGE_TO_PROBE, TRACKING_MM, Hand, compose_rigid, turned


def matrix(pose: Rigid) -> Array:
    return np.vstack([np.array(pose.rows), [0, 0, 0, 1]])


def test_composed_is_the_product_of_matrices() -> None:
    one, other = turned(0.1, -0.2, 0.3, 0.9, (1, 2, 3)), turned(-0.4, 0.1, 0.2, 0.8, (-5, 0, 7))
    np.testing.assert_allclose(matrix(compose_rigid(one, other)), matrix(one) @ matrix(other), atol=1e-12)
    np.testing.assert_allclose(matrix(compose_rigid(one, one.inverse())), np.eye(4), atol=1e-12)


def test_what_the_tracker_sees_leads_to_the_picture() -> None:
    hand = Hand(20)
    off = []
    for frame in range(20):
        look = hand.moment(frame)
        seen = compose_rigid(look.reference_to_tracker.inverse(), compose_rigid(look.probe_to_tracker, IMAGE_TO_PROBE))
        np.testing.assert_allclose(seen.rotation, look.image_to_reference.rotation, atol=1e-12)
        off.append(seen.translation - look.image_to_reference.translation)
    # two sensors, each seen a little beside where it is
    assert 0.5 < np.std(off) / (TRACKING_MM * np.sqrt(2)) < 1.5


def test_the_sweep_goes_along_the_arm_with_the_beam_into_it() -> None:
    hand = Hand(50)
    places = [hand.moment(frame).image_to_reference for frame in range(50)]
    along = np.array([place.translation[1] for place in places])
    assert abs(along[0]) < 2 and abs(along[-1] - LENGTH_MM) < 2
    assert (np.diff(along) > 0.5).all(), "no slice twice"
    for place in places:
        assert place.rotation[0, 0] < -0.98 and place.rotation[2, 1] > 0.98


def test_a_hand_shakes_and_an_arm_breathes() -> None:
    hand = Hand(50)
    turns = np.array([hand.moment(frame).image_to_reference.rotation[1, 1] for frame in range(50)])
    assert np.ptp(turns) > 0.02
    arm = np.array([hand.moment(frame).reference_to_tracker.translation for frame in range(50)])
    assert (np.ptp(arm, axis=0) > 1).all()
