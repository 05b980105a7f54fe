"""``igtl-gateway replay``: send a recording to OpenIGTLink peers, to ROS, or to both."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from igtl_gateway.app.replay_settings import REPLAY
from igtl_gateway.cli.options import RECORDING_OR_BAG, add_file
from igtl_gateway.cli.ros_arguments import add_ros_arguments
from igtl_gateway.cli.settings import add_settings, common_options, faults_text

EXAMPLES = """\
  # serve the session to the first client
  igtl-gateway replay fixtures/star.mcap --to igtl
  # the same bytes in the same order, without pauses
  igtl-gateway replay out.mcap --to igtl --as-fast-as-possible
  # connect to a server
  igtl-gateway replay out.mcap --to igtl --connect 127.0.0.1:18944
  # connect to a server with TLS
  igtl-gateway replay out.mcap --to igtl --connect tls://or1.clinic:18944 \\
      --tls-cert me.pem --tls-ca clinic.pem
  # publish the recorded ROS messages at half speed
  igtl-gateway replay out.mcap --to ros --rate 0.5
  # repeat, with /clock for nodes with use_sim_time
  igtl-gateway replay out.mcap --to ros --clock --loop
  # seconds 12.5 to 15.5, to peers and ROS in the recorded order
  igtl-gateway replay out.mcap --to both --start 12.5 --duration 3
  # set all stamps to the time of sending, for peers that reject old stamps
  igtl-gateway replay out.mcap --to igtl --restamp now
  # one message for each press of →
  igtl-gateway replay out.mcap --to igtl --step
  # recompute the outputs from the recorded inputs with this version
  igtl-gateway replay out.mcap --to igtl --through-gateway
  # inject faults
  igtl-gateway replay out.mcap --to igtl \\
      --fault loss=1%,jitter=20ms,corrupt=0.1% --seed 7
  # send a topic of a rosbag2 MCAP file as a device
  igtl-gateway replay bag.mcap --to igtl --send /camera/image=Cam
  # send the recorded bytes, whatever the peer can read
  igtl-gateway replay out.mcap --to igtl --exact
  # select streams
  igtl-gateway replay out.mcap --to igtl --streams 'IMAGE/*'

TIME is in seconds from the beginning, in UTC seconds, or a date and time such
as 2026-11-21T08:00:00Z.  A replay that starts or jumps into the middle first
sends the latched state before it: static transforms, plans, surfaces and the
last status.  At every rate the same messages are sent in the same order.  A
slow reader slows the replay down; nothing is dropped.

keys on a terminal:
  space  pause or resume            ↑ ↓  change the rate by 10 %
  →      next message while paused  q    quit

ROS services of /igtl_gateway_replay, with --to ros, as in `ros2 bag play`:
  ~/pause ~/resume ~/toggle_paused ~/is_paused ~/seek ~/play_next ~/burst
  ~/set_rate ~/get_rate

exit code 1 if the replay is stopped, or if ROS rejects messages (for example
of a type that is not installed); the other messages are sent."""

#: Options that the short help shows.
COMMON = common_options(REPLAY)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_file(parser, RECORDING_OR_BAG)
    add_settings(parser, REPLAY, fault_injection=faults_text())
    add_ros_arguments(parser.add_argument_group("ROS"), "remapping, namespace, log level")


def runner() -> Callable[[argparse.Namespace], int]:
    from igtl_gateway.cli.replay_run import run  # here: the help does not wait for it

    return run
