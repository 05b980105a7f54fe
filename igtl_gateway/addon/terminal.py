"""The verb of an add-on: its row, its options, its output, its progress."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.base.natural import natural as natural
    from igtl_gateway.base.quantities import by_count as by_count
    from igtl_gateway.base.quantities import clock_text as clock_text
    from igtl_gateway.base.quantities import count_text as count_text
    from igtl_gateway.base.quantities import counted as counted
    from igtl_gateway.base.quantities import duration_text as duration_text
    from igtl_gateway.base.quantities import few_text as few_text
    from igtl_gateway.base.quantities import moment_text as moment_text
    from igtl_gateway.base.quantities import rate_text as rate_text
    from igtl_gateway.base.quantities import seconds_text as seconds_text
    from igtl_gateway.base.quantities import size_text as size_text
    from igtl_gateway.cli.common import stop_event as stop_event
    from igtl_gateway.cli.common import utc_text as utc_text
    from igtl_gateway.cli.merge_output import print_merge as print_merge
    from igtl_gateway.cli.next_steps import PROGRAM as PROGRAM
    from igtl_gateway.cli.next_steps import command as command
    from igtl_gateway.cli.next_steps import print_next as print_next
    from igtl_gateway.cli.options import RECORDING_OR_BAG as RECORDING_OR_BAG
    from igtl_gateway.cli.options import add_file as add_file
    from igtl_gateway.cli.options import add_json as add_json
    from igtl_gateway.cli.options import add_output as add_output
    from igtl_gateway.cli.options import add_overwrite as add_overwrite
    from igtl_gateway.cli.options import add_streams as add_streams
    from igtl_gateway.cli.options import default as default
    from igtl_gateway.cli.options import definitions as definitions
    from igtl_gateway.cli.options import file_name as file_name
    from igtl_gateway.cli.options import new_recording as new_recording
    from igtl_gateway.cli.options import output_file as output_file
    from igtl_gateway.cli.options import parser_of as parser_of
    from igtl_gateway.cli.terminal import PROGRESS as PROGRESS
    from igtl_gateway.cli.terminal import PROGRESS_VARIABLE as PROGRESS_VARIABLE
    from igtl_gateway.cli.terminal import Parser as Parser
    from igtl_gateway.cli.terminal import aligned as aligned
    from igtl_gateway.cli.terminal import cell as cell
    from igtl_gateway.cli.terminal import clear_live_line as clear_live_line
    from igtl_gateway.cli.terminal import is_terminal as is_terminal
    from igtl_gateway.cli.terminal import live_line as live_line
    from igtl_gateway.cli.terminal import print_json as print_json
    from igtl_gateway.cli.terminal import print_line as print_line
    from igtl_gateway.cli.terminal import width as width
    from igtl_gateway.cli.verbs import CONVERT as CONVERT
    from igtl_gateway.cli.verbs import INSPECT as INSPECT
    from igtl_gateway.cli.verbs import KEEP as KEEP
    from igtl_gateway.cli.verbs import MANY as MANY
    from igtl_gateway.cli.verbs import RARE as RARE
    from igtl_gateway.cli.verbs import Verb as Verb

HOMES: Homes = (
    # Its row in the table of verbs, and the groups of the help
    ("cli.verbs", "CONVERT INSPECT KEEP MANY RARE Verb"),
    # Its options
    (
        "cli.options",
        "RECORDING_OR_BAG add_file add_json add_output add_overwrite add_streams default definitions "
        "file_name new_recording output_file parser_of",
    ),
    # Its output and its progress
    (
        "cli.terminal",
        "PROGRESS PROGRESS_VARIABLE Parser aligned cell clear_live_line is_terminal live_line print_json print_line "
        "width",
    ),
    ("cli.common", "stop_event utc_text"),
    ("base.natural", "natural"),
    (
        "base.quantities",
        "by_count clock_text count_text counted duration_text few_text moment_text rate_text seconds_text size_text",
    ),
    ("cli.merge_output", "print_merge"),
    # What the user may run next
    ("cli.next_steps", "PROGRAM command print_next"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
