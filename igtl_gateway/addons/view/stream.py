"""Recording streams: into a file, or to a running viewer."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import rerun as rr

from igtl_gateway.addon import ViewerError
from igtl_gateway.addons.view.blueprints import blueprint, choose
from igtl_gateway.addons.view.contents import SessionContents

APPLICATION = "igtl-gateway"
_LITTLE = 1 << 20  #: bytes: with less free space a disk counts as full, because rerun writes larger blocks
_FLUSH_S = 600.0  #: what a disk may take for the rest of a recording


def to_file(out: Path, identity: str, application: str = APPLICATION) -> rr.RecordingStream:
    """Open a stream into a file; equal sessions with the same ``identity`` give equal recordings.

    ``application``: has a layout of its own in the viewer.

    Raises OSError if the file cannot be written.
    """
    # rerun's error does not give the cause, and where not even its first block can be written it waits without end
    with open(os.open(out, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb", buffering=0) as file:
        if file.write(bytes(_LITTLE)) < _LITTLE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file.truncate(0)
    recording = rr.RecordingStream(application, recording_id=identity, send_properties=False)
    recording.save(out)
    return recording


def to_viewer(url: str) -> rr.RecordingStream:
    """Open a stream to a viewer.  Raises ViewerError if there is none."""
    recording = rr.RecordingStream(APPLICATION)
    try:
        recording.connect_grpc(url)
    except (RuntimeError, ValueError) as error:
        raise ViewerError(f"{url}: {error}") from None
    return recording


def arrange(recording: rr.RecordingStream, name: str, seen: SessionContents) -> str:
    """Send the blueprint ``name``, or with "" the one for the contents; return its name.  Raises ConfigError."""
    name = name or choose(seen)
    recording.send_blueprint(blueprint(name, seen))
    return name


def close(recording: rr.RecordingStream, out: Path | None = None) -> None:
    """Send the rest and close the stream (into the file ``out``).

    Raises OSError if the file is incomplete: rerun writes it in a thread that ends silently on an error.
    """
    try:
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        full = out is not None and shutil.disk_usage(out.parent).free < _LITTLE
        raise OSError("the disk is full" if full else str(error)) from None
    finally:
        recording.disconnect()
