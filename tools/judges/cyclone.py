"""Eclipse Cyclone DDS, another vendor's DDS, as a foreign ROS 2 node at the gateway.

``python tools/judges/cyclone.py [--site FOLDER]``: where the package ``cyclonedds`` is, if this Python cannot import it
(``pip install --no-deps --target FOLDER cyclonedds``).  Writes docs/evidence/real-programs/cyclone.jsonl; exit code 1
if anything differs.  Services are not compared: each RMW has a form of its own for the numbers of requests.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from igtl_gateway.convert.interfaces import SHARES
from tests.integration.bridge import RosClient
from tools.judges import results, ros_types

NODE = Path(__file__).with_name("programs") / "cyclone_node.py"
#: Nothing leaves this machine; the buffer that ROS's guide to its tuning asks for.
LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='true'/></Interfaces></General>"
    "<Internal><SocketReceiveBufferSize min='default' max='8MB'/></Internal></Domain></CycloneDDS>"
)
VERSION = "from importlib.metadata import version; print(version('cyclonedds'))"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--site", default="", metavar="FOLDER", help="where cyclonedds is installed")
    site = parser.parse_args().site
    asked = [sys.executable, "-c", VERSION]
    version = subprocess.run(asked, env={"PYTHONPATH": site}, capture_output=True, text=True, check=True).stdout.strip()
    program = [str(NODE), *map(str, SHARES)]
    node = RosClient("cyclone", program=program, PYTHONPATH=site, CYCLONEDDS_URI=LOOPBACK)
    return results.write("cyclone", "Eclipse Cyclone DDS", version, "ROS 2 node", results.summed(ros_types.judge(node)))


if __name__ == "__main__":
    sys.exit(main())
