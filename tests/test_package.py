"""``igtl_gateway/__init__.py``: the public names load at their first use."""

from __future__ import annotations

import subprocess
import sys

import pytest

import igtl_gateway


def test_import_alone_loads_nothing_else() -> None:
    program = "import sys; before = set(sys.modules); import igtl_gateway; print(*sorted(set(sys.modules) - before))"
    run = subprocess.run([sys.executable, "-S", "-c", program], capture_output=True, text=True, check=True)
    packages = {name.partition(".")[0] for name in run.stdout.split()}
    assert packages - sys.stdlib_module_names == {"igtl_gateway"}
    assert not packages & {"argparse", "dataclasses", "inspect"}  # each costs the command line milliseconds


def test_every_public_name_is_there() -> None:
    assert [name for name in igtl_gateway.__all__ if not hasattr(igtl_gateway, name)] == []
    assert set(igtl_gateway.__all__) <= set(dir(igtl_gateway))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'igtl_gateway' has no attribute 'opne'"):
        igtl_gateway.opne  # noqa: B018
