"""``igtl-gateway bridge``: the gateway, live, until Ctrl-C."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.cli.options import NODE_NAME
from igtl_gateway.cli.ros_arguments import add_ros_arguments
from igtl_gateway.cli.settings import add_absent, add_settings, common_options, faults_text
from igtl_gateway.config.setting import Setting, grouped
from igtl_gateway.config.settings import all_settings

EXAMPLES = """\
  # OpenIGTLink server on 127.0.0.1:18944, ROS 2 node /igtl_gateway
  igtl-gateway bridge
  # record all messages
  igtl-gateway bridge --record out.mcap
  # connect to a PLUS server
  igtl-gateway bridge --connect 127.0.0.1:18945
  # accept clients of one network
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow 192.168.7.0/24
  # accept clients that have a certificate of the clinic
  igtl-gateway bridge --listen 0.0.0.0:18944 --allow any \\
      --tls-cert or1.pem --tls-ca clinic.pem
  # peers receive messages but cannot send any
  igtl-gateway bridge --deny-in '*'
  # send a ROS topic to OpenIGTLink as device Camera
  igtl-gateway bridge --send /camera/image_raw=Camera
  # send the pose of a robot's tool as device tool0Tobase_link
  igtl-gateway bridge --tf-out tool0:base_link
  # join a ROS graph with rmw_zenoh, on any system and without ROS
  igtl-gateway bridge --ros zenoh:tcp/robot:7447
  # send images as encoded VIDEO
  igtl-gateway bridge --video-codec h264
  # show links, streams and recording on a page for browsers
  igtl-gateway bridge --record out.mcap --page
  # show the session live in rerun
  igtl-gateway bridge --view
  # record OpenIGTLink without ROS
  igtl-gateway bridge --no-ros --record slicer.mcap
  # start a new file after each GiB, in the directory long
  igtl-gateway bridge --record long.mcap --split-size 1024
  # save the last 30 s whenever key s is pressed
  igtl-gateway bridge --record last.mcap --snapshot 30
  # record the traffic between two OpenIGTLink programs
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 \\
      --record talk.mcap
  # delay their messages by 50 ms and drop 1 % of them
  igtl-gateway bridge --relay --listen :18944 --connect 127.0.0.1:18945 \\
      --fault delay=50ms,loss=1% --seed 7
  # wait until another node configures and activates the bridge
  igtl-gateway bridge --no-autostart
  # parameters, a namespace and another name of a topic, as for all ROS nodes
  igtl-gateway bridge --ros-args -p stall_s:=5.0 -r __ns:=/or1 \\
      -r /camera/image:=/microscope/image
  # counts for Prometheus at http://127.0.0.1:9464/metrics
  igtl-gateway bridge --metrics 9464

Messages of a device are published on /igtl/in/<device>/<kind>.  Messages that
are published on /igtl/out/<device> are sent to the peers."""

#: Options beside the settings: what the verb prints, how long it runs, where it runs.
OPTIONS = (
    Setting("duration", None, "stop after this time", kind=float, metavar="SECONDS", unit="s", common=True),
    Setting("types", False, "list all conversions of message types, then exit"),
    *grouped(
        "ROS",
        Setting("no_ros", False, "run without ROS, for OpenIGTLink only", common=True),
        Setting("node_name", "", "name of the ROS node", metavar="NAME", shown=NODE_NAME),
        Setting(
            "no_autostart",
            False,
            "start as a managed node that other nodes configure and activate, in the state unconfigured",
        ),
    ),
    *grouped(
        "diagnostics",
        Setting(
            "log_format",
            "text",
            "format of the output; json: one object per line, with its time",
            choices=("text", "json"),
        ),
        Setting("json", False, "same as --log-format json"),
    ),
)

#: Options that the short help shows.
COMMON = common_options((*all_settings(), *OPTIONS), "--ros-args")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    more = faults_text(
        "With --relay only.  in:NAME=VALUE applies to messages of clients to the",
        "server, out:NAME=VALUE to messages of the server to clients.",
    )
    add_settings(parser, (*all_settings(), *OPTIONS), fault_injection=more)
    add_absent(parser)
    add_ros_arguments(parser.add_argument_group("arguments of ROS"), "parameters, remapping, namespace, log level")


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.bridge_run import run  # here: the help does not wait for it

    return run
