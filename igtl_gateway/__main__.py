"""Entry point of ``python -m igtl_gateway``."""

import sys

from igtl_gateway.cli import main

sys.exit(main())
