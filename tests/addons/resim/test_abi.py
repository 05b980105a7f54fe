"""The declarations of `preload/_abi.h` against the headers of the ROS wheels: sizes and places of all fields."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import ROOT

INCLUDE = Path(sys.prefix) / "include"
#: Ours, that of ROS, and pairs of fields.
STRUCTS = {
    ("abi_allocator", "rcutils_allocator_t"): "state",
    ("abi_bytes", "rcutils_uint8_array_t"): "buffer length=buffer_length capacity=buffer_capacity allocator",
    ("abi_strings", "rcutils_string_array_t"): "size data allocator",
    ("abi_names_and_types", "rmw_names_and_types_t"): "names types",
    ("abi_time", "rmw_time_t"): "sec nsec",
    ("abi_qos", "rmw_qos_profile_t"): "history depth reliability durability deadline lifespan liveliness "
    "liveliness_lease=liveliness_lease_duration avoid_ros_namespace_conventions",
    ("abi_init_options", "rmw_init_options_t"): "domain_id enclave allocator impl",
    ("abi_context", "rmw_context_t"): "identifier=implementation_identifier options actual_domain_id impl",
    ("abi_node", "rmw_node_t"): "data name namespace_ context",
    ("abi_publisher", "rmw_publisher_t"): "data topic=topic_name options can_loan_messages",
    ("abi_subscription_options", "rmw_subscription_options_t"): "ignore_local_publications",
    ("abi_subscription", "rmw_subscription_t"): "data topic=topic_name options can_loan_messages "
    "is_filtered=is_cft_enabled",
    ("abi_named", "rmw_service_t"): "data name=service_name",
    ("abi_named", "rmw_client_t"): "data name=service_name",
    ("abi_guard", "rmw_guard_condition_t"): "data context",
    ("abi_wait_set", "rmw_wait_set_t"): "guards=guard_conditions data",
    ("abi_array", "rmw_subscriptions_t"): "count=subscriber_count items=subscribers",
    ("abi_array", "rmw_events_t"): "count=event_count items=events",
    ("abi_event", "rmw_event_t"): "data type=event_type",
    ("abi_request_id", "rmw_request_id_t"): "writer=writer_guid number=sequence_number",
    ("abi_service_info", "rmw_service_info_t"): "source_ns=source_timestamp received_ns=received_timestamp "
    "request=request_id",
    ("abi_gid", "rmw_gid_t"): "identifier=implementation_identifier data",
    ("abi_message_info", "rmw_message_info_t"): "source_ns=source_timestamp received_ns=received_timestamp "
    "publication_number=publication_sequence_number reception_number=reception_sequence_number "
    "publisher=publisher_gid from_intra_process",
    ("abi_sequence", "rmw_message_sequence_t"): "data size capacity allocator",
    ("abi_string", "rosidl_runtime_c__String"): "data size capacity",
    ("abi_source", "rosidl_runtime_c__type_description__TypeSource"): "type=type_name encoding text=raw_file_contents",
    ("abi_message_type", "rosidl_message_type_support_t"): "data func get_hash=get_type_hash_func "
    "get_description=get_type_description_func get_sources=get_type_description_sources_func",
    ("abi_service_type", "rosidl_service_type_support_t"): "data func request=request_typesupport "
    "response=response_typesupport get_description=get_type_description_func",
}
VALUES = {
    "ABI_TIMEOUT": "RMW_RET_TIMEOUT",
    "ABI_UNSUPPORTED": "RMW_RET_UNSUPPORTED",
    "ABI_GID_BYTES": "RMW_GID_STORAGE_SIZE",
    "ABI_RELIABLE": "RMW_QOS_POLICY_RELIABILITY_RELIABLE",
    "ABI_BEST_EFFORT": "RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT",
    "ABI_KEEP_LAST": "RMW_QOS_POLICY_HISTORY_KEEP_LAST",
    "ABI_KEEP_ALL": "RMW_QOS_POLICY_HISTORY_KEEP_ALL",
    "ABI_TRANSIENT_LOCAL": "RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL",
    "ABI_VOLATILE": "RMW_QOS_POLICY_DURABILITY_VOLATILE",
}


@pytest.mark.skipif(not (INCLUDE / "rmw").is_dir() or not shutil.which("cc"), reason="needs the headers of ROS")
def test_the_declarations_are_those_of_ros(tmp_path: Path) -> None:
    lines = ["#include <stddef.h>", '#include "rmw/rmw.h"', '#include "rmw/names_and_types.h"']
    lines += ['#include "rosidl_runtime_c/type_description/type_source__struct.h"']
    lines += ['#include "rosidl_runtime_c/service_type_support_struct.h"', '#include "_abi.h"']
    for (ours, theirs), fields in STRUCTS.items():
        lines.append(f'_Static_assert(sizeof(struct {ours}) == sizeof({theirs}), "{theirs}");')
        for field in fields.split():
            mine, _, other = field.partition("=")
            places = f"offsetof(struct {ours}, {mine}) == offsetof({theirs}, {other or mine})"
            lines.append(f'_Static_assert({places}, "{theirs}.{other or mine}");')
    lines += [f'_Static_assert((int){ours} == (int){theirs}, "{theirs}");' for ours, theirs in VALUES.items()]
    source = tmp_path / "abi.c"
    source.write_text("\n".join(lines) + "\n")
    includes = [f"-I{folder}" for folder in (ROOT / "igtl_gateway/addons/resim/preload", *INCLUDE.iterdir())]
    result = subprocess.run(
        ["cc", "-fsyntax-only", *includes, str(source)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
