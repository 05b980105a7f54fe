"""The table of formats that a session can be exported to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon.streams import GAP_NS

if TYPE_CHECKING:
    from igtl_gateway.addon.writing import Outputs
    from igtl_gateway.addons.exchange.account import ExportAccount
    from igtl_gateway.addons.exchange.selection import Recording


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A format that a session can be exported to.

    Attributes:
        text: the exported content, for the help text.
        next_step: what a user can do with the result ``{out}``; ``{count}`` is a query of its tables.
        export: writes the files and returns the account.
        suffixes: of the file; none: a directory.
        joins: whether it joins streams: then ``export`` takes ``gap_ns``, the largest gap to interpolate in.
        thins: whether it can leave out messages of fast streams: then ``export`` takes ``rate``, in Hz.
        shortens: whether digests can stand for large outputs: then ``export`` takes ``outputs``.
    """

    text: str
    next_step: str
    export: Callable[..., ExportAccount]
    suffixes: tuple[str, ...] = ()
    joins: bool = False
    thins: bool = False
    shortens: bool = False


def export_to(
    name: str,
    recording: Recording,
    out: Path,
    globs: Sequence[str],
    gap_ns: int = GAP_NS,
    rate: float = 0.0,
    outputs: Outputs = "full",
) -> ExportAccount:
    """Write a recording to ``out`` in a format of the table, and return the account.

    Args:
        name: of the format.
        recording: the session.
        out: file or directory.
        globs: select streams.
        gap_ns: of a format that joins streams: largest time between two poses that something may lie between.
        rate: of a format that thins streams: most messages of one in a second; 0: the default of the format.
        outputs: of a format that shortens: how large outputs are written.

    Raises GatewayError and OSError.
    """
    from igtl_gateway.addon.reading import RecordedStamps
    from igtl_gateway.addons.exchange.selection import count_skipped

    target = TARGETS[name]
    account = target.export(
        recording,
        out,
        globs,
        **({"gap_ns": gap_ns} if target.joins else {}),
        **({"rate": rate} if target.thins else {}),
        **({"outputs": outputs} if target.shortens else {}),
    )
    count_skipped(recording, globs, account)
    account.notes += [*account.senders.notes(), *RecordedStamps(recording).notes]
    return account


# -- each is imported when it is used: the help needs the titles, and some need extras ------------------------------


def _export_csv(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.csv_out import export_csv

    return export_csv(recording, out, globs, **more)


def _export_rosbag2(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.rosbag2_out import export_rosbag2

    return export_rosbag2(recording, out, globs, **more)


def _export_mcap(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.mcap_out import export_mcap

    return export_mcap(recording, out, globs, **more)


def _export_mrb(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.scene_out import export_mrb

    return export_mrb(recording, out, globs, **more)


def _export_mrml(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.scene_out import export_mrml

    return export_mrml(recording, out, globs, **more)


def _export_picture_sequence(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.scene_out import export_picture_sequence

    return export_picture_sequence(recording, out, globs, **more)


def _export_sequence(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.sequence_out import export_sequence

    return export_sequence(recording, out, globs, **more)


def _export_ply(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.surface_out import export_ply

    return export_ply(recording, out, globs, **more)


def _export_vtk(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.surface_out import export_vtk

    return export_vtk(recording, out, globs, **more)


def _export_nrrd(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.volume_out import export_nrrd

    return export_nrrd(recording, out, globs, **more)


def _export_parquet(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.arrow_out import export_parquet

    return export_parquet(recording, out, globs, **more)


def _export_arrow(recording: Recording, out: Path, globs: Sequence[str], **more: Any) -> ExportAccount:
    from igtl_gateway.addons.exchange.arrow_out import export_arrow

    return export_arrow(recording, out, globs, **more)


TARGETS = {
    "rosbag2": ExportFormat("ROS topics, as a directory for `ros2 bag`", "ros2 bag play {out}", _export_rosbag2),
    "mcap": ExportFormat(
        "the session with all bytes of its outputs, for Foxglove, `ros2 bag` and rerun",
        "open {out} in Foxglove or rerun, or `ros2 bag play {out}`",
        _export_mcap,
        (".mcap",),
        shortens=True,
    ),
    "igs.mha": ExportFormat(
        "an IMAGE and its TRANSFORMs, as one tracked sequence",
        "open {out} in PLUS, or in 3D Slicer with its extension SlicerIGSIO; --to mrb opens without one",
        _export_sequence,
        (".mha",),
        joins=True,
    ),
    "mrb": ExportFormat(
        "all streams, as one scene that plays in 3D Slicer",
        "open {out} in 3D Slicer and press play (module Sequences)",
        _export_mrb,
        (".mrb",),
        thins=True,
    ),
    "mrml": ExportFormat(
        "the same scene as a directory",
        "open the .mrml of {out} in 3D Slicer",
        _export_mrml,
        thins=True,
    ),
    "seq.nrrd": ExportFormat(
        "the pictures of one stream that do not move, as one file",
        "open {out} in 3D Slicer (as Volume Sequence)",
        _export_picture_sequence,
        (".nrrd",),
        thins=True,
    ),
    "csv": ExportFormat(
        "poses, strings, numbers: a directory with one table per stream",
        "open the tables of {out} in a spreadsheet",
        _export_csv,
    ),
    "parquet": ExportFormat(
        "all messages, units in the schema: a directory with one table per stream",
        "duckdb -c {count}",
        _export_parquet,
    ),
    "arrow": ExportFormat(
        "the same as files of Arrow IPC (Feather)", "pandas.read_feather reads each file of {out}", _export_arrow
    ),
    "ply": ExportFormat(
        "surfaces and clouds: a directory with one file per message",
        "open the files of {out} in MeshLab or CloudCompare",
        _export_ply,
    ),
    "vtk": ExportFormat(
        "surfaces and clouds with all attributes: a directory with one file per message",
        "open the files of {out} in ParaView or 3D Slicer",
        _export_vtk,
    ),
    "nrrd": ExportFormat(
        "images and volumes: a directory with one file per message",
        "open the files of {out} in 3D Slicer or MITK",
        _export_nrrd,
    ),
}
