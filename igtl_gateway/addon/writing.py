"""New files: beside their place until they are whole; sessions, and sessions of several recorders."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.base.systems.files import lock as lock_handle
    from igtl_gateway.record.sessionfile import merged as merged
    from igtl_gateway.record.sessionfile.channels import SEQUENCES as SEQUENCES
    from igtl_gateway.record.sessionfile.chunk_columns import channels_of as channels_of
    from igtl_gateway.record.sessionfile.chunk_rows import MessageRows as MessageRows
    from igtl_gateway.record.sessionfile.chunk_rows import RowStream as RowStream
    from igtl_gateway.record.sessionfile.definition import Definition as Definition
    from igtl_gateway.record.sessionfile.definition import FileDefinitions as FileDefinitions
    from igtl_gateway.record.sessionfile.definition import another_definition as another_definition
    from igtl_gateway.record.sessionfile.large_outputs import LargeOutputs as LargeOutputs
    from igtl_gateway.record.sessionfile.large_outputs import Outputs as Outputs
    from igtl_gateway.record.sessionfile.merged import Definitions as Definitions
    from igtl_gateway.record.sessionfile.merged import Method as Method
    from igtl_gateway.record.sessionfile.new_file import create_file as create_file
    from igtl_gateway.record.sessionfile.new_file import empty_file as empty_file
    from igtl_gateway.record.sessionfile.new_file import make_folder as make_folder
    from igtl_gateway.record.sessionfile.new_file import open_new as open_new
    from igtl_gateway.record.sessionfile.new_file import open_text as open_text
    from igtl_gateway.record.sessionfile.new_file import os_error_text as os_error_text
    from igtl_gateway.record.sessionfile.new_file import write_bytes as write_bytes
    from igtl_gateway.record.sessionfile.new_file import write_text as write_text
    from igtl_gateway.record.sessionfile.replaced_folder import replaced_folder as replaced_folder
    from igtl_gateway.record.sessionfile.schemas import RosTypes as RosTypes
    from igtl_gateway.record.sessionfile.side_file import SIDE_FILE as SIDE_FILE
    from igtl_gateway.record.sessionfile.stream import McapStream as McapStream
    from igtl_gateway.record.sessionfile.whole_files import check_folder as check_folder
    from igtl_gateway.record.sessionfile.whole_files import check_target as check_target
    from igtl_gateway.record.sessionfile.whole_files import is_unfinished as is_unfinished
    from igtl_gateway.record.sessionfile.whole_files import write_error as write_error
    from igtl_gateway.record.sessionfile.whole_files import written as written
    from igtl_gateway.record.sessionfile.whole_files import written_folder as written_folder
    from igtl_gateway.record.sessionfile.writer import SessionWriter as SessionWriter

#: Names that are others there; the rest of the group is above.
__all__ = ["lock_handle"]

HOMES: Homes = (
    # New files: written beside their place, moved there when they are whole
    ("record.sessionfile.whole_files", "check_folder check_target is_unfinished write_error written written_folder"),
    ("record.sessionfile.replaced_folder", "replaced_folder"),
    (
        "record.sessionfile.new_file",
        "create_file empty_file make_folder open_new open_text os_error_text write_bytes write_text",
    ),
    ("base.systems.files", "lock_handle=lock"),
    # Sessions
    ("record.sessionfile.writer", "SessionWriter"),
    ("record.sessionfile.side_file", "SIDE_FILE"),
    ("record.sessionfile.large_outputs", "LargeOutputs Outputs"),
    ("record.sessionfile.definition", "Definition FileDefinitions another_definition"),
    ("record.sessionfile.schemas", "RosTypes"),
    # A session of several recorders
    ("record.sessionfile", "merged"),
    ("record.sessionfile.merged", "Definitions Method"),
    ("record.sessionfile.channels", "SEQUENCES"),
    ("record.sessionfile.chunk_columns", "channels_of"),
    ("record.sessionfile.chunk_rows", "MessageRows RowStream"),
    ("record.sessionfile.stream", "McapStream"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
