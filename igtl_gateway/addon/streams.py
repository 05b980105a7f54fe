"""Streams of a recording as numbers: on one clock, and as poses, pictures, clouds and tables."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.api.arrow_tables import TableMaker as TableMaker
    from igtl_gateway.api.arrow_tables import fitted as fitted
    from igtl_gateway.api.arrow_tables import unified as unified
    from igtl_gateway.api.cdr_columns import Column as Column
    from igtl_gateway.api.cdr_columns import NotColumns as NotColumns
    from igtl_gateway.api.cdr_columns import ros_columns as ros_columns
    from igtl_gateway.api.clouds import Cloud as Cloud
    from igtl_gateway.api.columns import HEAD as HEAD
    from igtl_gateway.api.columns import LINK as LINK
    from igtl_gateway.api.columns import MAX_COLUMNS as MAX_COLUMNS
    from igtl_gateway.api.columns import MAX_NUMBERS as MAX_NUMBERS
    from igtl_gateway.api.columns import Cells as Cells
    from igtl_gateway.api.columns import TooLong as TooLong
    from igtl_gateway.api.columns import name_igtl_fields as name_igtl_fields
    from igtl_gateway.api.columns import name_ros_fields as name_ros_fields
    from igtl_gateway.api.columns import table_rows as table_rows
    from igtl_gateway.api.csv_lines import Cell as Cell
    from igtl_gateway.api.csv_lines import cell_text as cell_text
    from igtl_gateway.api.csv_lines import csv_lines as csv_lines
    from igtl_gateway.api.csv_lines import number_cell as number_cell
    from igtl_gateway.api.csv_lines import rows_of_cell as rows_of_cell
    from igtl_gateway.api.field_numbers import FieldNumbers as FieldNumbers
    from igtl_gateway.api.field_numbers import FieldReader as FieldReader
    from igtl_gateway.api.igtl_columns import POSE_TYPES as POSE_TYPES
    from igtl_gateway.api.igtl_columns import crcs as crcs
    from igtl_gateway.api.igtl_columns import pose_columns as pose_columns
    from igtl_gateway.api.igtl_columns import pose_rows as pose_rows
    from igtl_gateway.api.igtl_columns import quaternions_of as quaternions_of
    from igtl_gateway.api.images import Images as Images
    from igtl_gateway.api.images import find_row as find_row
    from igtl_gateway.api.named_numbers import NAME_FIELDS as NAME_FIELDS
    from igtl_gateway.api.named_numbers import by_name as by_name
    from igtl_gateway.api.named_numbers import completed as completed
    from igtl_gateway.api.placement import COORDINATE as COORDINATE
    from igtl_gateway.api.placement import ImagePlacement as ImagePlacement
    from igtl_gateway.api.placement import Vector as Vector
    from igtl_gateway.api.placement import has_own_normal as has_own_normal
    from igtl_gateway.api.poses import between_poses as between_poses
    from igtl_gateway.api.poses import matrices_of as matrices_of
    from igtl_gateway.api.posing import tools_of as tools_of
    from igtl_gateway.api.posing import transforms_of as transforms_of
    from igtl_gateway.gateway.log.interleaving import Interleaving as Interleaving
    from igtl_gateway.gateway.log.joining import END_NS as END_NS
    from igtl_gateway.gateway.log.joining import pick as pick
    from igtl_gateway.gateway.log.one_clock import OneClock as OneClock
    from igtl_gateway.gateway.log.one_clock import StreamTimes as StreamTimes
    from igtl_gateway.gateway.log.one_clock import one_clock as one_clock
    from igtl_gateway.gateway.log.timing import GAP_NS as GAP_NS
    from igtl_gateway.gateway.stream_units import StreamUnits as StreamUnits
    from igtl_gateway.gateway.stream_units import arm_units as arm_units

HOMES: Homes = (
    # Two streams: one clock for both, and the messages that belong to a moment
    ("gateway.log.one_clock", "OneClock StreamTimes one_clock"),
    ("gateway.log.interleaving", "Interleaving"),
    ("gateway.log.joining", "END_NS pick"),
    ("gateway.log.timing", "GAP_NS"),
    ("gateway.stream_units", "StreamUnits arm_units"),
    # Poses, and numbers of joints by their names
    ("api.poses", "between_poses matrices_of"),
    ("api.posing", "tools_of transforms_of"),
    ("api.igtl_columns", "POSE_TYPES crcs pose_columns pose_rows quaternions_of"),
    ("api.named_numbers", "NAME_FIELDS by_name completed"),
    # Pictures and where they are, clouds
    ("api.images", "Images find_row"),
    ("api.placement", "COORDINATE ImagePlacement Vector has_own_normal"),
    ("api.clouds", "Cloud"),
    # Tables
    ("api.columns", "Cells HEAD LINK MAX_COLUMNS MAX_NUMBERS TooLong name_igtl_fields name_ros_fields table_rows"),
    ("api.arrow_tables", "TableMaker fitted unified"),
    ("api.cdr_columns", "Column NotColumns ros_columns"),
    ("api.field_numbers", "FieldNumbers FieldReader"),
    ("api.csv_lines", "Cell cell_text csv_lines number_cell rows_of_cell"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
