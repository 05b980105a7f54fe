"""Recording streams: into a file, or to a viewer that runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import rerun as rr

from igtl_gateway.errors import ViewerError
from igtl_gateway.view.blueprints import blueprint, choose
from igtl_gateway.view.contents import SessionContents

APPLICATION = "igtl-gateway"
_LITTLE = 1 << 20  #: bytes: a disk with less is full, as rerun writes more than this at once


def to_file(out: Path, identity: str) -> rr.RecordingStream:
    """A stream into a file; equal sessions of equal ``identity`` give equal recordings.

    Raises OSError where the file cannot be written.
    """
    out.open("wb").close()  # rerun's own error does not say why
    recording = rr.RecordingStream(APPLICATION, recording_id=identity, send_properties=False)
    recording.save(out)
    return recording


def to_viewer(url: str) -> rr.RecordingStream:
    """A stream to a viewer.  Raises ViewerError where there is none."""
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.connect_grpc(url)
    except (RuntimeError, ValueError) as error:
        raise ViewerError(f"{url}: {error}") from None
    return recording


def arrange(recording: rr.RecordingStream, name: str, seen: SessionContents) -> str:
    """Send the blueprint of that name, or ("") the one that fits; its name.  Raises ConfigError."""
    name = name or choose(seen)
    recording.send_blueprint(blueprint(name, seen))
    return name


def close(recording: rr.RecordingStream, out: Path | None = None) -> None:
    """Send what is left, and end the stream (into the file ``out``).

    Raises OSError where the file did not take everything: rerun writes it in a thread of its own that ends silently.
    """
    try:
        recording.flush()
    except RuntimeError as error:
        full = out is not None and shutil.disk_usage(out.parent).free < _LITTLE
        raise OSError("the disk is full" if full else str(error)) from None
    finally:
        recording.disconnect()
