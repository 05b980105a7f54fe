"""Entry point of ``python -m igtl_gateway``."""

import sys

from igtl_gateway.start import main

sys.exit(main())
