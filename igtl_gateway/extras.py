"""The extras of the package, and the one sentence that says how to get what is missing."""

from __future__ import annotations

#: Module that an extra brings → the extra, and what else would do.
_EXTRAS = {
    "rclpy": ("ros", " (Linux x86_64), or source a ROS 2 installation"),
    "rerun": ("view", ""),
    "av": ("video", ""),
    "nibabel": ("nifti", ""),
    "pcapng": ("pcap", ""),
    "pyigtl": ("dev", ""),
}


def missing(module: str, error: ImportError | None = None) -> str:
    """The sentence for a module of an extra that cannot be imported.

    >>> missing("rerun")
    'rerun is not installed here: pip install "igtl-gateway[view]"'

    Args:
        module: ``rclpy``, ``rerun``, ``av``, ``nibabel`` …
        error: what the import raised; told where it is not merely that there is no such module.
    """
    extra, instead = _EXTRAS[module]
    found = "is not installed here"
    if error is not None and not (isinstance(error, ModuleNotFoundError) and error.name == module):
        found = f"cannot be imported ({str(error).partition(chr(10))[0]})"
    return f'{module} {found}: pip install "igtl-gateway[{extra}]"{instead}'
