"""The extras of the package, and the message that explains how to install a missing module."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from igtl_gateway.base.addons import FOLDER, check_present
from igtl_gateway.base.errors import Unavailable

#: Extra → what needs it, for the documentation.
PURPOSES = {
    "ros": "`bridge`, `replay --to ros`, `doctor` and the verbs of the laboratory on a machine without a sourced ROS 2 "
    "(Linux x86_64)",
    "zenoh": "`bridge --ros zenoh`, `zenoh-router`, sites",
    "websocket": "`--listen ws://HOST:PORT`: browsers and headsets as peers",
    "view": "`view`, `bridge --view`",
    "video": "`bridge --video-codec`, encoded pictures in `view`, `review` and `deidentify`",
    "nifti": "`import` of NIfTI volumes",
    "plot": "`sync --plot`",
    "pcap": "`import` of pcapng, Wireshark's default",
    "hdf5": "`import` of kinematics in HDF5",
    "arrow": "`export --to parquet`, `export --to arrow`, tables in Python",
    "pandas": "data frames in Python",
    "lerobot": "`export --to lerobot`, `import` of its data sets",
    "cohort": "`cohort`",
    "seal": "`seal`, `seal keys`, `verify --seal`, `bridge --seal`",
    "lab": "`simulate`, `bench`, `demo`",
}
#: Module → the extras that install it, the usual one first.
_MODULES = {
    "zenoh": ("zenoh",),
    "xxhash": ("zenoh",),
    "wsproto": ("websocket",),
    "h11": ("websocket",),
    "rclpy": ("ros",),
    "rerun": ("view",),
    "av": ("video", "lerobot"),
    "matplotlib": ("plot",),
    "nibabel": ("nifti",),
    "pcapng": ("pcap",),
    "h5py": ("hdf5",),
    "pyarrow": ("arrow", "pandas", "lerobot", "cohort"),
    "pandas": ("pandas",),
    "dask": ("cohort",),
    "distributed": ("cohort",),
    "duckdb": ("cohort",),
    "obstore": ("cohort",),
    "cryptography": ("seal",),
    "blake3": ("seal",),
    "rfc3161_client": ("seal",),
    "pyigtl": ("dev",),
}
#: Module → what helps as well.
_ALTERNATIVES = {"rclpy": " (Linux x86_64), or source a ROS 2 installation; `bridge --no-ros` needs neither"}
#: Module → the first Python that has it.
_FIRST = {"rerun": (3, 11)}
#: The extra whose modules the running function needs.
_IN_USE: ContextVar[str] = ContextVar("extra in use", default="")


def missing(module: str, error: ImportError | None = None) -> str:
    """Return the error message for a module of an extra that cannot be imported.

    >>> missing("rerun")
    'rerun is not installed here: pip install "igtl-gateway[view]"'

    Args:
        module: ``rclpy``, ``rerun``, ``av``, ``nibabel`` …
        error: exception of the import; it is part of the message unless it is that the module does not exist.
    """
    first = _FIRST.get(module)
    if first and sys.version_info[:2] < first:
        return f"{module} is not installed here: it needs Python {first[0]}.{first[1]} or newer"
    extras, in_use = _MODULES[module], _IN_USE.get()
    extra = in_use if in_use in extras else extras[0]
    found = "is not installed here"
    if error is not None and not (isinstance(error, ModuleNotFoundError) and error.name == module):
        found = f"cannot be imported ({str(error).partition(chr(10))[0]})"
    return f'{module} {found}: pip install "igtl-gateway[{extra}]"{_ALTERNATIVES.get(module, "")}'


@contextmanager
def in_use(extra: str = "") -> Iterator[None]:
    """Context manager: a module that is missing inside is one of this extra, or of its usual one.

    Raises Unavailable for the failed import of a module of any extra, MissingAddon for that of an absent add-on.
    """
    token = _IN_USE.set(extra or _IN_USE.get())
    try:
        yield
    except ImportError as error:
        name = error.name or ""
        if name == FOLDER or name.startswith(f"{FOLDER}."):
            check_present(name.removeprefix(FOLDER).strip(".").partition(".")[0])
        module = name.partition(".")[0]
        if module not in _MODULES:
            raise
        raise Unavailable(missing(module, error)) from None
    finally:
        _IN_USE.reset(token)
