"""The review of a plan as a function: ``igtl_gateway.review``."""

from __future__ import annotations

from dataclasses import fields

from igtl_gateway.addon.reading import AnyRecording, session_of
from igtl_gateway.addons.review import Review, Thresholds
from igtl_gateway.addons.review.choices import CLOUDS, ReviewSelection
from igtl_gateway.addons.review.recorded import checked_thresholds, review_session


def review(
    path: AnyRecording,
    *,
    plan: str = "",
    cloud: str = "",
    tool: str = "",
    clouds: int = CLOUDS,
    thresholds: Thresholds | None = None,
) -> Review:
    """Review the suture plan of a recording: the distance of each point from the tissue, and the depth noise there.

    Args:
        path: the recording, or a rosbag2 MCAP file: its path, or an open one.
        plan: topic of the plan; "": pairs of points on the tissue.
        cloud: topic of the point cloud; "": the largest.
        tool: topic or frame of the tool; "": the one that comes nearest.
        clouds: maximum number of clouds, evenly spread over time.
        thresholds: the limits that make a figure a reason; None: the defaults.

    Returns:
        The review: ``review.last.wrong`` has the wrong stitches of the last version of the plan.

    Raises:
        GatewayError: the recording has no plan or no cloud.
        ConfigError: it does not have the requested ones, or a threshold is out of range.

    Examples:
        >>> len(review("fixtures/star.mcap").last.stitches)
        11
    """
    limits = thresholds or Thresholds()
    checked_thresholds({each.name: getattr(limits, each.name) for each in fields(Thresholds)}, clouds)
    with session_of(path) as file:
        return review_session(file, ReviewSelection(plan, cloud, tool, clouds), limits)
