"""``igtl-gateway seal keys``: the keys of seals."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.cli.terminal import print_line
from igtl_gateway.record.seal.keys import SigningKey, key_id, load_trusted
from igtl_gateway.record.sessionfile.beside import write_error

EXAMPLES = """\
  # write the private key recorder.key (mode 0600) and recorder.key.pub
  igtl-gateway seal keys new recorder.key
  # a new key that the old one introduces: who trusts the old one trusts it
  igtl-gateway seal keys rotate recorder.key recorder-2027.key
  # the identifiers of keys
  igtl-gateway seal keys show recorder.key.pub

Give FILE.pub to those who check, by another way than the recordings."""

NEW, ROTATE, SHOW = "new", "rotate", "show"
_COUNTS = {NEW: (1, "one file: KEY"), ROTATE: (2, "two files: OLD NEW")}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("action", choices=(NEW, ROTATE, SHOW), help="what to do")
    parser.add_argument("files", metavar="FILE", nargs="+", type=Path, help="file of a key; rotate: OLD NEW")


def run(options: argparse.Namespace) -> int:
    files: list[Path] = options.files
    count, expected = _COUNTS.get(options.action, (len(files), ""))
    if len(files) != count:
        raise ConfigError(f"keys {options.action}: found {len(files)} files, expected {expected}")
    if options.action == SHOW:
        for path in files:
            _show(path)
        return 0
    key = SigningKey.load(files[0]).successor() if options.action == ROTATE else SigningKey.generate()
    path = files[-1]
    public = path.with_name(f"{path.name}.pub")
    # a program that is killed between the two leaves no secret
    _create_pair([(public, key.public_pem()), (path, key.private_pem())])
    print_line(f"{path}: private key {key.id}, readable by its owner only", f"{public}: public key")
    return 0


def _show(path: Path) -> None:
    try:
        for public in sorted(load_trusted([path])):
            print_line(f"{path}: public key {key_id(public)}")
    except ConfigError:
        key = SigningKey.load(path)
        after = f", introduced by {len(key.introductions)} key(s) before it" if key.introductions else ""
        print_line(f"{path}: private key {key.id}{after}")


def _create_pair(files: Sequence[tuple[Path, bytes]]) -> None:
    """Write new files of mode 0600, all or none.  Raises ConfigError if one exists, GatewayError."""
    created: list[Path] = []
    try:
        for path, data in files:
            _create(path, data, created)
    except BaseException:
        for path in created:
            with suppress(OSError):
                path.unlink()
        raise


def _create(path: Path, data: bytes, created: list[Path]) -> None:
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        created.append(path)
        with open(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(handle)
    except FileExistsError:
        raise ConfigError(f"{path}: exists already, expected a new file: keys are not replaced") from None
    except (OSError, ValueError) as error:
        raise write_error(path, error) from None
