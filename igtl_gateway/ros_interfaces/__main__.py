"""``python -m igtl_gateway.ros_interfaces``: compile all packages before their first import; print their folders."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from igtl_gateway.cli.terminal import print_line
from igtl_gateway.ros_interfaces.cache import package_path
from igtl_gateway.ros_interfaces.definitions import PACKAGES

_STAND_INS = Path(__file__).parent / "python"


def main() -> int:
    """Print one line for each package; return 1 if at least one cannot be imported, otherwise 0."""
    failed = False
    for package in PACKAGES:
        real = find_spec(package)
        try:
            if real and real.origin and _STAND_INS not in Path(real.origin).parents:
                print_line(f"{package}: {Path(real.origin).parent} (installed)")
            else:
                print_line(f"{package}: {package_path(package)[0]}")
        except ImportError as error:
            print_line(str(error), error=True)
            failed = True
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
