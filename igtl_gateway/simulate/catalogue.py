"""The scenarios by name."""

from __future__ import annotations

from collections.abc import Iterator

from igtl_gateway.config import Config, ToIgtlRow
from igtl_gateway.session.entry import Kind
from igtl_gateway.simulate import every_type, paper_types, star
from igtl_gateway.simulate.scenario import Input, Scenario, fact, from_peer, link_down, link_up, merged
from igtl_gateway.stamp import NS_PER_S, ns_to_ticks
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import Status, String

_NAVIGATION = "127.0.0.1:51000"

_STAR_CONFIG = Config(
    base_frame=star.BASE_FRAME,
    to_igtl=tuple(
        ToIgtlRow(topic=topic, device=device, type=igtl_type)
        for topic, device, igtl_type in (
            ("/star/cloud", "TissueCloud", "POLYDATA"),
            ("/star/camera/image", "Camera", "IMAGE"),
            ("/star/tool", "ToolToBase", "TRANSFORM"),
            ("/star/camera_pose", "CameraToBase", "TRANSFORM"),
            ("/star/nir_markers", "NirMarkers", "POINT"),
            ("/star/plan", "SuturePlan", "POLYDATA"),
            ("/star/plan_points", "PlanPoints", "POINT"),
            ("/star/status", "StarStatus", "STRING"),
        )
    ),
)


def _star_inputs(duration_s: float | None) -> Iterator[Input]:
    """The robot's side from ``star``, and a navigation program that follows and approves."""
    seconds = star.DURATION_S if duration_s is None else duration_s
    start_ns, end_ns = star.START_NS, star.START_NS + round(seconds * NS_PER_S)
    robot = (
        Input(message.time_ns, Kind.ROS_IN, message.cdr, message.topic, message.type, source_ns=message.sent_ns)
        for message in star.messages(seconds, start_ns)
    )

    def said(at_ns: int, message: Message) -> Input:
        return from_peer(at_ns, 1, message)

    begin_ns, approve_ns = start_ns - 200_000_000, start_ns + 2 * NS_PER_S
    navigation = (
        fact(
            begin_ns - 1_000_000, "synthetic", "synthetic session: no robot, no patient, no camera; see simulate star"
        ),
        link_up(begin_ns, 1, _NAVIGATION),
        said(begin_ns + 10_000_000, Message("STATUS", "Navigation", Status(1, 0, "", "ready"), ns_to_ticks(begin_ns))),
        said(approve_ns, Message("STRING", "Navigation", String.of("plan approved"), ns_to_ticks(approve_ns))),
    )
    return merged(navigation, robot, (link_down(end_ns + NS_PER_S, 1, _NAVIGATION),))


SCENARIOS = {
    "star": Scenario(
        "STAR-like suturing session, synthetic: coloured clouds, camera, tool, markers, suture plan",
        _STAR_CONFIG,
        _star_inputs,
    ),
    "paper-types": Scenario(
        "one message of each type of the ROS-IGTL-Bridge paper, in both directions, synthetic",
        Config(),
        lambda _duration_s: paper_types.inputs(),
    ),
    "every-type": Scenario(
        "every row of the conversion table, every query, commands, tf chains, metadata and kinds of peers, synthetic",
        every_type.CONFIG,
        lambda _duration_s: every_type.inputs(),
    ),
}
