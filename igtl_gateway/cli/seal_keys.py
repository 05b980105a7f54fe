"""``igtl-gateway seal keys``: the keys of seals."""

from __future__ import annotations

import argparse
import os
from contextlib import suppress
from pathlib import Path

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.quantities import count_text
from igtl_gateway.cli.terminal import print_line
from igtl_gateway.record.seal.keys import SigningKey, key_id, load_trusted, trusted_with
from igtl_gateway.record.sessionfile.new_file import open_new
from igtl_gateway.record.sessionfile.whole_files import written

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
        raise ConfigError(f"keys {options.action}: found {count_text(len(files), 'file')}, expected {expected}")
    if options.action == SHOW:
        for path in files:
            _show(path)
        return 0
    old = SigningKey.load(files[0]) if options.action == ROTATE else None
    path = files[-1]
    public = path.with_name(f"{path.name}.pub")
    if key := _left_alone(path, public, old):
        note = "found without its public key, and kept"
        with written(public) as place:
            _write(place, key.public_pem())
    else:
        key = old.successor() if old else SigningKey.generate()
        note = "readable by its owner only"
        _create_pair(path, public, key)
    print_line(f"{path}: private key {key.id}, {note}", f"{public}: public key")
    return 0


def _show(path: Path) -> None:
    try:
        for public in sorted(load_trusted([path])):
            print_line(f"{path}: public key {key_id(public)}")
    except ConfigError:
        key = SigningKey.load(path)
        after = f", introduced by {count_text(len(key.introductions), 'key')} before it" if key.introductions else ""
        print_line(f"{path}: private key {key.id}{after}")


def _left_alone(path: Path, public: Path, old: SigningKey | None) -> SigningKey | None:
    """Return the private key that a program left which was killed before it wrote the public one; None: no files.

    Args:
        path: the private key.
        public: its public key.
        old: the key that must introduce it; None: it may be any key.

    Raises ConfigError for other files.
    """
    if os.path.lexists(path) and not os.path.lexists(public):
        with suppress(ConfigError):
            key = SigningKey.load(path)
            if not old or key.public in trusted_with(frozenset([old.public]), key.introductions) - {old.public}:
                return key
    for each in (public, path):
        if os.path.lexists(each):
            raise ConfigError(f"{each}: exists already, expected a new file: keys are not replaced")
    return None


def _create_pair(path: Path, public: Path, key: SigningKey) -> None:
    """Write both files, then move them to their places: the private key first, as the public one follows from it.

    Raises GatewayError.
    """
    with written(public) as public_place, written(path) as place:
        _write(public_place, key.public_pem())
        _write(place, key.private_pem())


def _write(place: Path, data: bytes) -> None:
    """Write a new file so that it survives a power failure.  Raises OSError."""
    with open_new(place) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
