"""One program of a measurement: see ``programs``."""

import sys

from igtl_gateway_lab.bench.programs import main

sys.exit(main(sys.argv[1:]))
