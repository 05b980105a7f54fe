"""Files and text of others, read within limits; ROS messages by the definitions in a file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.base.untrusted import cpu_time as cpu_time
    from igtl_gateway.base.untrusted import definitions as ros_definitions
    from igtl_gateway.base.untrusted import files as files
    from igtl_gateway.base.untrusted import limits as limits
    from igtl_gateway.base.untrusted import shape as shape
    from igtl_gateway.base.untrusted import unpack as unpack
    from igtl_gateway.base.untrusted.decoding import MessageDecoder as MessageDecoder
    from igtl_gateway.base.untrusted.decoding import new_store as new_store
    from igtl_gateway.base.untrusted.decoding import register_types as register_types
    from igtl_gateway.base.untrusted.definition_checks import Types as Types
    from igtl_gateway.base.untrusted.definition_checks import weight as code_size
    from igtl_gateway.base.untrusted.derived_types import DerivedType as DerivedType
    from igtl_gateway.base.untrusted.derived_types import messages_of as messages_of
    from igtl_gateway.base.untrusted.elements import ElementCounter as ElementCounter
    from igtl_gateway.base.untrusted.files import deadline_of as deadline_of
    from igtl_gateway.base.untrusted.files import is_same as is_same
    from igtl_gateway.base.untrusted.files import near_file as near_file
    from igtl_gateway.base.untrusted.files import open_file as open_file
    from igtl_gateway.base.untrusted.files import read_bytes as read_bytes
    from igtl_gateway.base.untrusted.files import size_of as size_of
    from igtl_gateway.base.untrusted.files import stored_bytes as stored_bytes
    from igtl_gateway.base.untrusted.limits import Deadline as Deadline
    from igtl_gateway.base.untrusted.limits import check_limit as check_limit
    from igtl_gateway.base.untrusted.numbers import whole_number as whole_number
    from igtl_gateway.base.untrusted.parquet_file import parquet_columns as parquet_columns
    from igtl_gateway.base.untrusted.parquet_file import read_parquet as read_parquet
    from igtl_gateway.base.untrusted.parquet_file import read_parquet_schema as read_parquet_schema
    from igtl_gateway.base.untrusted.text import check_nesting as check_nesting
    from igtl_gateway.base.untrusted.text import parse_json as parse_json
    from igtl_gateway.base.untrusted.text import printable as printable
    from igtl_gateway.base.untrusted.xml_text import Element as Element
    from igtl_gateway.base.untrusted.xml_text import parse_xml as parse_xml
    from igtl_gateway.base.untrusted.yaml_text import parse_yaml as parse_yaml

#: Names that are others there; the rest of the group is above.
__all__ = ["code_size", "ros_definitions"]

HOMES: Homes = (
    # Files and their limits
    ("base.untrusted", "cpu_time files limits"),
    ("base.untrusted.files", "deadline_of is_same near_file open_file read_bytes size_of stored_bytes"),
    ("base.untrusted.limits", "Deadline check_limit"),
    ("base.untrusted", "unpack"),
    # Text and tables
    ("base.untrusted", "shape"),
    ("base.untrusted.numbers", "whole_number"),
    ("base.untrusted.text", "check_nesting parse_json printable"),
    ("base.untrusted.xml_text", "Element parse_xml"),
    ("base.untrusted.yaml_text", "parse_yaml"),
    ("base.untrusted.parquet_file", "parquet_columns read_parquet read_parquet_schema"),
    # ROS messages of any type, by the definitions in a file
    ("base.untrusted", "ros_definitions=definitions"),
    ("base.untrusted.decoding", "MessageDecoder new_store register_types"),
    ("base.untrusted.definition_checks", "Types code_size=weight"),
    ("base.untrusted.derived_types", "DerivedType messages_of"),
    ("base.untrusted.elements", "ElementCounter"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
