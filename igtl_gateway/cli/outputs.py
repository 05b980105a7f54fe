"""Files that a verb writes: checked before the work, and complete or absent at the end."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from igtl_gateway.errors import ConfigError, GatewayError
from igtl_gateway.sessionfile.new_file import empty_file


def check_target(path: Path, *, overwrite: bool) -> None:
    """Raise ConfigError for an existing file without --overwrite, GatewayError if the file cannot be written."""
    try:
        found = path.stat()
    except FileNotFoundError:
        if not path.parent.is_dir():
            raise GatewayError(f"cannot write to {path}: there is no folder {path.parent}") from None
        return
    except (OSError, ValueError) as error:
        raise write_error(path, error) from None
    if not overwrite:
        raise ConfigError(f"{path}: exists already, expected a new file or --overwrite")
    if not stat.S_ISREG(found.st_mode):
        raise GatewayError(f"cannot write to {path}: it is not a regular file, expected one or a new name")


@contextmanager
def written(path: Path) -> Iterator[Path]:
    """Context manager: an empty file in the same directory, which replaces ``path`` if the ``with`` block succeeds.

    Raises GatewayError if it cannot be created.
    """
    partial = path.with_name(f".igtl-gateway-{os.getpid()}.part{path.suffix if path.suffix.isascii() else ''}")
    try:
        empty_file(partial, "xb")
    except OSError as error:
        raise write_error(path, error) from None
    try:
        yield partial
        try:
            os.replace(partial, path)
        except OSError as error:
            raise write_error(path, error) from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_error(path: Path, error: Exception) -> GatewayError:
    """What to raise where ``path`` cannot be written."""
    return GatewayError(f"cannot write to {path}: {getattr(error, 'strerror', None) or error}")
