"""The codes of notes, of which a trigger of the black box names one."""

from __future__ import annotations

#: All of them, in alphabetical order; a test compares them with those in the sources.
NOTE_CODES = (
    "accept_failed active adapted age_unknown arm_unit ask_clock bad_crc callback_failed calm cell_scalars clock_step "
    "colours_left_out command_backwards command_early command_force command_frame command_joint_count "
    "command_joint_range command_joint_speed command_not_allowed command_not_finite command_not_rigid "
    "command_old command_refused command_speed command_timeout command_type command_unknown_state "
    "command_unstamped command_unwritten command_word command_workspace connect_failed conversion "
    "coordinate_zero cycle deidentified denied deviation_read direction_not_unit empty encoding_changed fault "
    "fault_disconnect field_left_out float32_attribute frame_renamed frame_shared fresh halted idle imported inactive "
    "internal_error latched_forgotten link_down link_up listen_failed listened malformed mark mark_refused "
    "mark_time name_cut name_shared native_passage no_base no_conversion no_frame_name no_interfaces "
    "no_partner no_source not_a_pose not_a_rotation not_finite not_for_peer not_valid out_of_memory own_parent "
    "page peer_clock peer_clock_step peer_no_clock peer_profile prologue_incomplete "
    "query_unanswered queue_drop queue_full rate_limited record_again "
    "record_continued record_drop record_failed record_late record_moves record_on_time record_part_lost "
    "record_paused record_rate record_refused record_resumed record_snapshot record_space record_space_low "
    "record_split_held record_stalled record_started record_stopped record_thread record_undefined "
    "record_waits refused retention_clock retention_deleted retention_failed retention_kept ros_bad_attachment "
    "ros_bad_token ros_call_refused ros_callback_failed ros_held_old ros_hold_overflow ros_incompatible_qos "
    "ros_lost ros_publish_failed ros_receive_failed ros_refused ros_slow ros_subscribed ros_type_hash "
    "ros_unknown_type setting shown_instead site_clock site_command_late site_latency site_lost "
    "site_over_budget source_came stale stalled stamp_backwards stamp_future stamp_still stamps_corrected stream "
    "stream_back stream_refused stream_silent stream_started text_cut tick tls_failed too_large "
    "too_many_frames too_many_streams trajectory_not_drawn transform_status trigger trigger_incomplete "
    "trigger_saved truncated uint32_as_float64 unit_jump unknown_frame unknown_status unreachable "
    "unreadable_note upload_confirmed upload_differs upload_reached upload_waits video_changed video_drop "
    "video_failed video_refused websocket_failed wire_error zenoh_connected zenoh_left zenoh_lost zenoh_no_router "
    "zenoh_not_closed"
).split()
