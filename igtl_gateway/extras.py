"""The extras of the package, and the message that explains how to install a missing module."""

from __future__ import annotations

#: Module → the extra that installs it, and an alternative.
_EXTRAS = {
    "zenoh": ("zenoh", ""),
    "xxhash": ("zenoh", ""),
    "rclpy": ("ros", " (Linux x86_64), or source a ROS 2 installation"),
    "rerun": ("view", ""),
    "av": ("video", ""),
    "matplotlib": ("plot", ""),
    "nibabel": ("nifti", ""),
    "pcapng": ("pcap", ""),
    "pyarrow": ("arrow", ""),
    "pandas": ("pandas", ""),
    "dask": ("cohort", ""),
    "duckdb": ("cohort", ""),
    "obstore": ("cohort", ""),
    "cryptography": ("seal", ""),
    "blake3": ("seal", ""),
    "rfc3161_client": ("seal", ""),
    "pyigtl": ("dev", ""),
}


def missing(module: str, error: ImportError | None = None) -> str:
    """Return the error message for a module of an extra that cannot be imported.

    >>> missing("rerun")
    'rerun is not installed here: pip install "igtl-gateway[view]"'

    Args:
        module: ``rclpy``, ``rerun``, ``av``, ``nibabel`` …
        error: exception of the import; it is part of the message unless it is that the module does not exist.
    """
    extra, alternative = _EXTRAS[module]
    found = "is not installed here"
    if error is not None and not (isinstance(error, ModuleNotFoundError) and error.name == module):
        found = f"cannot be imported ({str(error).partition(chr(10))[0]})"
    return f'{module} {found}: pip install "igtl-gateway[{extra}]"{alternative}'
