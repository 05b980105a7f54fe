"""The settings that a bridge has with this add-on.  Loaded at each start of a bridge: nothing here imports zenoh."""

from __future__ import annotations

from igtl_gateway.addon.settings import DDS, HOST, ROS_GRAPH, Setting, grouped
from igtl_gateway.addons.zenoh.notation import ZENOH, ZENOH_ENDPOINT, ros_middleware, site_class, site_name

SETTINGS = grouped(
    "ROS",
    Setting(
        "ros",
        DDS,
        "the way to the ROS graph: dds by an installed ROS; zenoh without ROS, as nodes with rmw_zenoh, through the "
        f"router at ENDPOINT, such as {ZENOH_ENDPOINT}",
        HOST,
        metavar=f"{DDS}|{ZENOH}[:ENDPOINT]",
        reads=ros_middleware,
        parameter=False,
        common=True,
    ),
    Setting(
        "site",
        "",
        "name of this site, with --ros zenoh: streams have priorities (commands, poses, data, pictures), and the "
        "clocks of the gateways of other sites and the latency of their streams are measured",
        HOST,
        metavar="NAME",
        reads=site_name,
        parameter=False,
        needs=(ROS_GRAPH,),
    ),
    Setting(
        "site_budget",
        0,
        "send no more than this over Zenoh, with --site: pictures are dropped first, then data; poses and commands "
        "never",
        HOST,
        metavar="KIB/S",
        unit="KiB/s",
        least=0,
        most=10_000_000,
        shown="0, no limit",
        parameter=False,
        needs=("site",),
    ),
    Setting(
        "site_classes",
        (),
        "class of the topics that match, with --site: commands, poses, data or pictures (repeatable)",
        HOST,
        "--site-class",
        metavar="GLOB=CLASS",
        reads=site_class,
        shown="by type",
        parameter=False,
        adds=True,
        needs=("site",),
    ),
)
