"""What every test shares: a ROS 2 of its own, Hypothesis profiles, the order of the files.

The environment is set on import, before any test module can start ROS 2, and set firmly rather than by
default: a test must never talk to the graph of a robot that happens to be configured in the user's shell.
"""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from tests import domains
from tests.timing import MOST_READING_S

_ros_log_dir = tempfile.mkdtemp(prefix="igtl-gateway-ros-log-")
# Not a fixture: child processes of the last tests may still write there.
atexit.register(shutil.rmtree, _ros_log_dir, ignore_errors=True)

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(domains.OWN)
os.environ["ROS_LOG_DIR"] = _ros_log_dir

# Several tests run at a time: with a thread for each core, numpy's small systems take twice the processor time, because
# its idle threads wait in loops.  Set before numpy is imported, and inherited by the programs that tests start.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

# Colours and live lines as on the usual terminal, whatever the shell or the gate has.
os.environ["TERM"] = "xterm-256color"
os.environ.pop("NO_COLOR", None)

# Lines are not wrapped: what a test looks for stands on one line.  Tests of the layout set it.
os.environ["COLUMNS"] = "1000"

# Compiled modules are kept, whatever the shell sets: a run starts some hundred Python processes; reading 240 test
# files with their assertions takes each worker 16 s instead of 5.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Thirteen thousand items stay in memory, and Python's collector looks at all of them again and again: with these
# thresholds, and without what the collection has made, it takes 6 % of the time instead of 14.
gc.set_threshold(20_000, 20, 50)

# "fast" is the same on every run, so a red test is red for everybody; "deep" looks for new examples.
# No deadline, and none for making examples: the time depends more on the machine than on the code.
_UNTIMED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("fast", _UNTIMED, max_examples=20, derandomize=True)
settings.register_profile("deep", _UNTIMED, max_examples=2000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fast"))


#: The second tier: files whose tests are all marked ``slow``, which ``make test-fast`` leaves out.  A slow test in any
#: other file has the mark itself.
SLOW = (
    # the longest first
    "gateway/fastpath/test_passage_streams.py",
    "addons/resim/test_programs.py",
    "integration/test_live_faults.py",
    "addons/resim/test_faults.py",
    "addons/resim/test_queues.py",
    "addons/resim/test_quiet.py",
    "addons/resim/test_igtl_peer.py",
    "addons/resim/test_bisect.py",
    "addons/resim/test_api.py",
    "addons/review/test_assess.py",
    "integration/test_cli_bridge.py",
    "test_gateway_fuzz.py",
    "addons/exchange/test_targets.py",
    "addons/exchange/test_arrow_out.py",
    "cli/test_replay.py",
    "test_fixtures.py",
    "addons/review/test_verb.py",
    "cli/test_exit_codes.py",
    "cli/test_slice.py",
    "integration/test_recording_faults.py",
    "integration/test_replay_ros.py",
    "integration/test_calls.py",
    "integration/test_rosbag2_folder.py",
    "lab/simulate/test_star.py",
    "addons/view/test_shots.py",
    "addons/review/test_error.py",
    "integration/test_simulate.py",
    "integration/test_black_box_live.py",
    "integration/test_crash.py",
    "integration/test_relay.py",
    "integration/test_lifecycle.py",
    "integration/test_demo.py",
    "test_notebooks.py",
    "test_site.py",
    "test_release.py",
    "integration/test_hostile.py",
    "integration/test_hostile_crowds.py",
    "integration/test_interop.py",
    "integration/test_ros_types.py",
    "integration/test_script_peers.py",
    "lab/cli/test_bench.py",
    "lab/bench/test_hop.py",
    "lab/bench/test_native.py",
    "lab/bench/test_peers.py",
    "lab/bench/test_works.py",
    "addons/view/test_stream.py",
    "addons/resim/test_page.py",
    "addons/resim/test_regressions.py",
    "addons/resim/test_coordinator.py",
    "addons/resim/test_verb.py",
    "addons/zenoh/test_site.py",
    "edges/ros/test_distributions.py",
    "test_examples.py",
)

#: Files that only ``make test-long`` runs → a file of the gate that checks a part of their subject in less time.  They
#: do not come here by folders: what takes little time belongs to the gate.
LONG_FILES = {
    "addons/exchange/test_targets.py": "addons/exchange/test_folder.py",
    "addons/resim/test_igtl_peer.py": "addons/resim/test_verb.py",
    "addons/resim/test_programs.py": "addons/resim/test_verb.py",
    "integration/test_black_box_live.py": "record/test_black_box.py",
    "integration/test_clock_live.py": "gateway/dialogue/test_clocks.py",
    "integration/test_hostile_crowds.py": "integration/test_hostile.py",
    "integration/test_browser_peer.py": "edges/tcp/websocket/test_framed_socket.py",
    "integration/test_hostile_websocket.py": "edges/tcp/websocket/test_framed_socket.py",
    "integration/test_websocket_live.py": "edges/tcp/websocket/test_framed_socket.py",
    "integration/test_near_names.py": "base/test_near.py",
    "integration/test_page_person.py": "addons/page/test_server.py",
    "integration/test_page_views.py": "addons/page/test_process.py",
    "integration/test_page_widths.py": "addons/page/test_now.py",
    "integration/test_zenoh_session.py": "addons/zenoh/test_site.py",
    "lab/bench/test_hop.py": "lab/bench/test_rounds.py",
    "lab/bench/test_native.py": "lab/bench/test_probe.py",
    "lab/bench/test_peers.py": "lab/bench/test_payloads.py",
    "lab/bench/test_works.py": "lab/bench/test_bounds.py",
    "test_notebooks.py": "api/test_recording.py",
}

#: The third tier: how the names of tests begin.
LONG = (
    "test_truth.py::test_nothing_is_silent_in_a_world_of_each_condition",
    "base/untrusted/test_cpu_time.py::test_a_verb_ends_inside_of_an_endless_step",
    "integration/test_live_faults.py::test_over_a_bad_line_everything_arrives_once_and_in_order[delay]",
    "replay/test_segments.py::test_the_first_difference_is_that_of_the_whole",
    "replay/test_segments.py::test_what_the_digest_leaves_out_decides_no_output",
    "replay/test_segments.py::test_streams_that_are_collected_in_any_order",
    "base/test_extras.py::test_a_verb_without_its_library_is_one_line",
    "addons/view/test_stream.py::test_every_message_is_a_row",
    "addons/view/test_stream.py::test_nothing_is_static_and_has_rows",
    "addons/view/test_rows.py::test_fixtures_look_the_same_drawn_at_once[ultrasound.mcap]",
    "addons/view/test_rows.py::test_fixtures_look_the_same_drawn_at_once[star.mcap]",
    "test_costs.py::test_four_times_the_parts_cost_four_times_as_much",
    "addons/cohort/test_segments.py::test_segments_have_the_result_of_the_file[here-right-10]",
    "integration/test_simulate.py::test_ctrl_c_ends_every_program_with_a_summary",
    "addons/exchange/test_scene_out.py::test_poses_are_the_recorded_ones_at_any_time[crtk",
    "addons/exchange/test_scene_out.py::test_poses_are_the_recorded_ones_at_any_time[star",
    "addons/exchange/test_scene_out.py::test_poses_are_the_recorded_ones_at_any_time[ultrasound",
    "addons/exchange/test_metaimage_out.py::test_itk_sees_images_where_they_were",
    "addons/lerobot/test_reading.py::test_a_flipped_bit_of_the_tasks_that_pandas_refuses_is_found",
    "addons/lerobot/test_reading.py::test_columns_of_any_type",
    "addons/lerobot/test_reading.py::test_a_small_table_of_many_wrong_episodes_is_soon_read",
    "cli/test_next_steps.py::test_the_proposed_commands_run",
    "test_start.py::test_an_interrupt_at_any_import_is_no_traceback[review]",
    "test_start.py::test_an_interrupt_at_any_import_is_no_traceback[export]",
    "gateway/test_acceptance.py::test_parts_and_snapshots_too[parts]",
    "gateway/test_acceptance.py::test_changed_copies_have_what_was_accepted",
    "gateway/to_ros/test_beforehand.py::test_messages_unlike_the_compiled_stream_before_them",
    "replay/test_slice_columns.py::test_the_state_before_a_window_is_the_same",
    "addons/resim/test_verb.py::TestWithRos::test_exit_codes_and_reports",
    "addons/resim/test_bisect.py::TestWithRos::test_the_commit_is_found",
    "addons/resim/test_bisect.py::TestWithRos::test_commits_that_do_not_build_before_it",
    "addons/resim/test_page.py::test_the_output_is_real",
    "edges/ros_interfaces/test_compiling.py::test_the_compilation_of_a_killed_program_ends_and_leaves_nothing",
    "integration/test_late_joiners.py::test_what_is_lost_below_the_edge_is_counted",
    *LONG_FILES,
    *(f"integration/test_columns.py::test_no_line_is_wider_than_the_terminal[{columns}]" for columns in (60, 120)),
    *(f"addons/review/test_assess.py::test_the_{name}" for name in ("planted_", "distances_", "noise_")),
    "addons/cohort/test_segments.py::test_segments_have_the_result_of_the_file[Dask-",
    "addons/cohort/test_segments.py::test_segments_have_the_result_of_the_file[here-wrong",
    "addons/cohort/test_exporting.py::test_workers_give_the_bytes_of_this_process",
    "addons/cohort/test_running.py::test_killed_programs",
    "addons/cohort/test_running.py::test_a_killed_file",
    "addons/cohort/test_running.py::test_a_file_that_takes_too_long",
    "addons/page/test_jobs.py::test_a_review_of_a_file",
    "addons/page/test_process.py::test_a_session_is_run",
    "addons/page/test_recordings.py::test_a_slow_peer",
    "addons/page/test_replays.py::test_what_plays_without",
    "app/test_sealing.py::test_a_killed_recorder",
    "cli/test_exit_codes.py::test_the_same_cause_has_the_same_code[REFUSED",
    "cli/test_recover.py::test_a_folder_whose_last_part",
    "gateway/test_command_motion.py::test_in_random_worlds",
    "integration/test_hostile.py::test_what_is_answered",
    "integration/test_live_faults.py::test_the_network",
    "integration/test_recording_faults.py::test_a_disk_that_becomes_full[stop",
    "integration/test_simulate.py::test_the_acquisition",
    "record/sessionfile/test_conformance.py::test_every_verb",
    "record/test_black_box.py::test_no_trigger_is_lost",
    "addons/deidentify/test_repeated.py::test_every_fixture",
    "addons/exchange/test_chosen_rows.py::test_many_random_sessions",
    "addons/page/test_process.py::test_a_folder_without_a_bridge",
    "addons/page/test_process.py::test_a_port_in_use_is_a_note",
    "addons/page/test_process.py::test_the_bridge_goes_on_without_its_page",
    "addons/page/test_process.py::test_the_parameter_of_ros_opens_the_page",
    "addons/resim/test_causes.py::test_the_cause_is",
    *(f"addons/resim/test_verb.py::TestWithRos::test_{name}" for name in ("samples_", "a_window_", "what_a_timer_")),
    "addons/page/test_recordings.py::test_a_file_that_ends_the_process",
    "addons/resim/test_faults.py::test_a_compiler_that_takes_long",
    "addons/resim/test_api.py::TestTheFixture::test_in_a_project",
    "addons/view/test_rows.py::test_mutants",
    "app/test_bridge.py::test_every_part_of_a_session_verifies_alone[crtk",
    "app/test_ros_traffic.py::test_in_random_worlds",
    *(
        f"addons/test_absent.py::test_what_is_left_works_without_an_addon[{name}]"
        for name in ("sync", "merge", "deidentify", "upload", "page", "review", "resim", "cohort", "lerobot")
    ),
    "integration/test_fair_shares.py::test_a_good_peer_is_answered_beside_twenty_that_flood[COMMAND]",
    "integration/test_fair_shares.py::test_a_good_peer_is_answered_beside_twenty_that_flood[TRANSFORM]",
    "integration/test_marks_everywhere.py::test_every_verb_on_every_fixture",
    "record/sessionfile/test_recovery.py::test_mutants",
    "test_examples.py::test_a_planner_on_its",
    "integration/test_soak.py::test_load_with_guests_that_come_and_go",
    "lab/bench/test_bridges.py::test_a_bridge_that_ends_is_quoted",
    "lab/bench/test_bridges.py::test_one_that_is_not_ready_is_quoted",
    *(f"lab/cli/test_bench.py::test_{name}" for name in ("a_real_run", "a_bridge_that", "the_mixed_load")),
    "replay/test_rows.py::test_many_sessions",
    "replay/test_segments.py::test_a_change_in_the_recording_is_never_hidden",
    "replay/test_segments.py::test_killed_processes",
    "replay/test_slice_columns.py::test_a_slice_of_a_fixture",
    *(f"test_gateway_fuzz.py::test_{name}" for name in ("igtl_in", "ros_in", "the_gateway_stands")),
    *(f"test_release.py::test_the_{name}" for name in ("sums", "wheels", "sdist", "sbom")),
    *(f"test_site.py::test_{name}" for name in ("every_link", "no_markup", "the_search", "the_words")),
    # what differs little from its neighbours in the gate
    *(
        f"addons/lerobot/test_comparing.py::test_damage_is_found[{name}"
        for name in (
            "shifted_state-episode 0: observation.state: frame 7: found [-v2.1",
            "shifted_picture-episode 0: observation.images.left: frame 5: found the picture of entry-v2.1",
            "no_stats-stats of action: found no min, max-v2.1",
            "wrong_count-action: count: found [7], expected-v2.1",
            "wrong_picture_mean-observation.images.left: mean: found [0.9, 0.9, 0.9]-v3.0",
            "slightly_wrong_picture_mean-observation.images.left: mean: found [[[0.-v3.0",
            "small_spot-observation.images.left: frame 3: found a mean squared difference of-v3.0",
            "flipped_byte-.mp4: found another SHA-256-v3.0",
            "null_cell-observation.state: found 1 missing values-v3.0",
            "stats_of_an_episode-episode 1: stats of observation.state",
            "climbing_checksums",
            "null_in_the_provenance",
            "wrong_mean-meta",
        )
    ),
    *(f"gateway/test_verdicts.py::test_it_verifies_and_so_do_its_slices[{tens}" for tens in (2, 3)),
    *(
        f"addons/view/test_rows.py::test_fixtures_look_the_same_drawn_at_once[{name}.mcap]"
        for name in ("brain", "lego")
    ),
    *(f"addons/view/test_rows.py::test_sessions_of_all_sorts_look_the_same[{seed}]" for seed in (2, 3)),
    *(
        f"addons/resim/test_faults.py::test_a_fault_is_one_line[{name}-"
        for name in (
            *(
                "becomes",
                "becomes_a_sleeper",
                "ends",
                "exits",
                "is_killed",
                "is_stopped",
                "leaves",
                "mistypes",
                "stops",
            ),
        )
    ),
    *(
        f"addons/resim/test_faults.py::test_a_process_that_waits_for_work_is_no_fault[{name}]"
        for name in ("shared memory", "pool of threads", "launcher", "shell", "pool, asked later")
    ),
    "addons/resim/test_faults.py::test_ctrl_c_at_any_moment",
    "addons/resim/test_faults.py::test_a_timeout_of_real_time_weakens_the_guarantee[mutex]",
    *(f"addons/resim/test_quiet.py::test_a_topic_with_a_mistake_cannot_be_judged[options{row}-" for row in (1, 2)),
    *(
        f"addons/resim/test_quiet.py::test_a_callback_that_sleeps_for_ever_is_no_success[{row}"
        for row in ("apart", "rests")
    ),
    *(
        f"addons/resim/test_queues.py::test_the_oldest_message_is_dropped_and_counted[{row}]"
        for row in ("1-spin", "3-threads")
    ),
    "addons/resim/test_queues.py::test_a_service_keeps_its_last_ten_requests",
    *(
        f"addons/resim/test_regressions.py::test_a_regression_is_named[{name}]"
        for name in ("frame", "deg", "lost", "late")
    ),
    *(
        f"integration/test_recording_faults.py::test_a_recording_that_is_truncated_goes_on_in_the_next_file[{name}]"
        for name in ("one file-replaced", "parts-truncated")
    ),
    "integration/test_recording_faults.py::test_a_clock_that_is_set_by_an_hour_while_a_recording_is_made[back]",
    "integration/test_recording_faults.py::test_a_disk_that_is_full_from_the_start_is_a_reason_not_to_start[options1-",
    "integration/test_recording_faults.py::test_a_folder_of_parts_that_is_removed_is_told_at_once",
    "integration/test_recording_faults.py::test_a_limit_of_the_size_of_files",
    "integration/test_recording_faults.py::test_a_recording_that_is_removed_is_told_at_once[_remove_folder",
    "integration/test_cli_bridge.py::test_the_services_of_a_recording",
    "integration/test_cli_bridge.py::test_without_options_until_a_signal[15]",
    "integration/test_cli_bridge.py::test_other_topics_are_recorded[True]",
    "integration/test_cli_bridge.py::test_a_snapshot_by_signal",
    "integration/test_replay_ros.py::test_the_services_of_ros2_bag_play",
    "integration/test_replay_ros.py::test_what_ros_refuses_is_not_counted_as_sent",
    "integration/test_replay_ros.py::test_wrong_arguments_of_ros_are_one_line[arguments1",
    "integration/test_relay.py::test_a_relay_has_one_server[servers1]",
    "integration/test_relay.py::test_over_a_bad_line",
    "integration/test_crash.py::test_a_signal_to_all_processes_at_once_ends_it_in_order[2]",
    "integration/test_crtk.py::test_an_arm_that_subscribes_late_gets_no_stream_that_has_walked_away[True]",
    "integration/test_rosbag2_folder.py::test_so_is_that_of_a_recovered_folder",
    "integration/test_script_peers.py::test_images_with_asyncio_through_our_relay",
    "integration/slicer/test_exports.py::test_slicer_reads_each_exported_table_of_a_fixture[brain]",
    "integration/slicer/test_exports.py::test_slicer_reads_each_exported_surface_of_a_fixture[vtk-lego]",
    *(
        f"gateway/fastpath/test_passage_streams.py::test_{name}"
        for name in (
            *(f"random_sessions_are_what_the_full_path_gives[{seed}]" for seed in (2, 3, 4, 5)),
            "poses_pass_beside_pictures[70000]",
            "a_burst_of_commands_beside_native_streams_moves_the_robot_at_its_limit[False]",
            "what_slicer_gets_with_its_stamp_as_metadata_passes_natively[False]",
            "large_messages_with_hostile_counts_are_what_the_full_path_gives[POINT]",
            "large_messages_with_hostile_counts_are_what_the_full_path_gives[POLYDATA]",
        )
    ),
    "gateway/test_acceptance.py::test_exports_have_what_was_accepted[arrow]",
    "native/test_rooms.py::test_a_header_of_the_kernel_compiles_alone",
    "lab/simulate/test_star.py::test_a_run_on_an_older_processor",
    "test_packaging.py::test_every_module_compiles_without_a_warning[python3.12]",
    "addons/test_absent.py::test_what_is_left_works_without_an_addon[exchange]",
    "addons/test_absent.py::test_what_is_left_works_without_an_addon[zenoh]",
    "addons/review/test_verb.py::test_phases_name_the_stitches",
    "addons/review/test_verb.py::test_on_a_terminal_it_is_coloured",
    *(
        f"addons/review/test_error.py::test_the_interval_holds_over_distances_and_shapes[{name}"
        for name in ("smoothed", "disparity", "speckle")
    ),
    "addons/deidentify/test_rules.py::test_a_sealed_recording_with_a_prologue_by_the_command_line",
    "addons/deidentify/test_session.py::test_what_is_made_of_a_sealed_recording_names_its_seal[changed]",
    "addons/exchange/test_scene_out.py::test_a_name_with_a_meaning_to_slicer_keeps_its_poses",
    "addons/exchange/test_scene_out.py::test_pictures_of_one_millisecond_leave_the_others_whole",
    "addons/exchange/test_scene_out.py::test_a_folder_has_the_same_scene",
    "addons/lerobot/test_export.py::test_two_arms_and_two_cameras[v2.1]",
    "addons/lerobot/test_export.py::test_a_sequence_of_plus[v3.0]",
    "record/sessionfile/test_recovery.py::test_more_mutants[2]",
    "record/sessionfile/test_recovery.py::test_chunks_are_copied_as_they_are[every-type]",
    "record/test_recorder.py::test_after_kill_9_of_both_everything_flushed_is_there[busy]",
    "cli/test_seal.py::test_a_kill_at_any_moment_leaves_nothing_or_what_the_next_run_completes[rotate",
    *(f"cli/test_main.py::test_closed_outputs_end_nothing_with_a_traceback[{name}]" for name in (">&- 2>&-", "2>&-")),
    *(f"test_start.py::test_an_interrupt_at_any_import_is_no_traceback[{verb}]" for verb in ("verify", "info")),
    *(f"test_written_files.py::test_a_program_that_is_ended[{number}]" for number in (2, 9)),
    "test_written_files.py::test_a_scene_whose_export_is_ended_is_not_there[--to mrml -o OUT-igtl_gateway",
    "test_written_files.py::test_a_scene_whose_export_is_ended_is_not_there[--to seq.nrrd",
    "addons/exchange/test_import_memory.py::test_the_largest_message_is_held_once[volume]",
    "addons/exchange/test_scene_out.py::test_items_of_one_millisecond_are_thinned_and_counted",
    "addons/lerobot/test_export.py::test_a_recipe_of_the_recording_works_as_it_is[star]",
    "addons/resim/test_faults.py::test_two_signals_as_of_timeout",
    "addons/resim/test_faults.py::test_a_process_that_waits_for_work_is_no_fault[helper]",
    "addons/resim/test_faults.py::test_a_fault_is_one_line[becomes_itself-",
    "addons/resim/test_queues.py::test_the_oldest_message_is_dropped_and_counted[3-spin]",
    "addons/resim/test_queues.py::test_a_queue_that_keeps_all_loses_nothing[timer]",
    "addons/review/test_error.py::test_the_interval_holds_over_distances_and_shapes[quantised",
    "addons/sync/test_lag.py::test_what_each_of_several_pairs_contributes",
    *(f"addons/sync/test_lag.py::test_an_insertion_from_place_to_place_chooses[{seed}]" for seed in (8, 37)),
    "addons/sync/test_lag.py::test_an_insertion_that_is_not_related_does_not_choose[2]",
    "addons/sync/test_lag.py::test_noise_of_other_frequencies_does_not_hide_a_lag[47]",
    "addons/sync/test_lags.py::test_hostile_values_and_stamps_are_refused[centuries]",
    "addons/test_absent.py::test_what_is_left_works_without_an_addon[view]",
    "addons/view/test_session.py::test_no_bytes_whatever_end_the_drawing[1]",
    "addons/view/test_rows.py::test_fixtures_look_the_same_drawn_at_once[crtk.mcap]",
    "cli/test_main.py::test_limits_are_lowered_and_raised_for_each_verb[review]",
    *(f"cli/test_terminal.py::test_a_file_name_that_is_no_utf8[environment{row}]" for row in (1, 2)),
    "edges/ros/test_env.py::test_publishers_and_subscriptions_keep_no_memory_of_the_largest_messages[False]",
    "integration/test_cli_bridge.py::test_kill_9_of_bridge_and_recorder_leaves_what_was_flushed",
    "integration/test_fair_shares.py::test_a_good_peer_is_answered_beside_twenty_that_flood[wrong CRC]",
    "integration/test_relay.py::test_a_replay_says_the_words",
    "integration/test_replay_ros.py::test_node_and_topics_are_where_ros_args_put_them",
    *(
        f"integration/test_script_peers.py::test_{name}[pyigtl]"
        for name in ("a_server_of_tracked_images", "points_that_are_changed", "wait_for_a_message")
    ),
    "record/sessionfile/test_derived.py::test_every_path_of_the_reader_gives_all_bytes[lz4]",
    "record/sessionfile/test_index_check.py::test_bytes_that_another_program_overwrites_while_it_is_recorded_are_found_later[info]",
    *(f"record/sessionfile/test_writer.py::test_pymcap_doctor_finds_no_errors[{name}]" for name in ("auto", "lz4")),
    *(
        f"replay/test_content_figures.py::test_a_recording_that_is_closed[{name}]"
        for name in ("lz4-process", "none-thread")
    ),
    "replay/test_verify.py::test_a_byte_of_any_message_of_every_type_that_came_in_is_found[60]",
    *(
        f"test_mistyped_names.py::test_a_wrong_name_fails_or_is_reported[cohort {words}"
        for words in ("review FILE -o OUT/t", "review FILE -o OUT/r", "sync FILE -o OUT/v")
    ),
    *(
        f"test_written_files.py::test_a_scene_whose_export_is_ended_is_not_there[--to mrb -o OUT.mrb-{name}-9]"
        for name in (
            "igtl_gateway.addons.exchange.scene_out._clock",
            "igtl_gateway.record.sessionfile.whole_files._move",
        )
    ),
    "native/test_kernel.py::test_the_program_has_the_whole_kernel",
    *(f"replay/test_recheck.py::test_{name}" for name in ("a_change_in_the_recording_is_found_with", "heads_that_are")),
    "gateway/fastpath/test_passage_streams.py::test_sessions_of_the_fast_path_are",
    *(f"replay/test_segments.py::test_{name}" for name in ("a_wrong_state_is_no_joint", "a_difference_that_a_wrong")),
    *(f"replay/test_rows.py::test_{name}" for name in ("a_stream_that_is_later", "mutants_are")),
    *(f"replay/test_slice_columns.py::test_{name}" for name in ("a_slice_of_a_changed", "entries_that_are_written")),
    "addons/exchange/test_arrow_out.py::test_so_is_a_random",
    "addons/exchange/test_chosen_rows.py::test_a_fixture",
    "addons/exchange/test_mcap_out.py::test_exports_are_those",
    *(
        f"addons/test_absent.py::test_what_is_left_works_without_an_addon[{name}]"
        for name in ("exchange", "view", "zenoh")
    ),
    "addons/page/test_recordings.py::test_a_recording_with_many_marks",
    "cli/test_seal.py::test_a_kill_at_any_moment",
    *(
        f"edges/ros_interfaces/test_compiling.py::test_an_interrupt_leaves_nothing_and_the_next_start_compiles[{name}]"
        for name in ("SIGHUP", "SIGTERM")
    ),
    "integration/test_interop.py::test_client_mode_outlives",
    "integration/test_lifecycle.py::test_the_command_line_waits",
    "record/sessionfile/test_recovery.py::test_more_mutants",
    "test_try_extras.py::test_the_oldest_and_the_newest_python",
    "test_try_install.py::test_an_upgrade",
    "test_try_install.py::test_each_installer",
)

#: Where several workers take files in turn, these go first: none of them must be left for the end.
LONGEST = (
    "integration/test_soak.py",
    "integration/test_hostile_files.py",
    "addons/test_absent.py",
    *SLOW,
    "replay/test_segments.py",
    "addons/view/test_rows.py",
    "replay/test_slice_columns.py",
    "addons/lerobot/test_reading.py",
    "addons/deidentify/test_rules.py",
    "addons/deidentify/test_session.py",
    "addons/page/test_process.py",
    "addons/page/test_recordings.py",
    "addons/lerobot/test_export.py",
    "native/test_turns.py",
    "test_start.py",
    "addons/lerobot/test_comparing.py",
    "test_written_files.py",
    "addons/sync/test_verb.py",
    "api/test_recording.py",
    "wire/test_bodies.py",
    "record/sessionfile/test_salvage.py",
    "cli/test_main.py",
    "record/test_recorder.py",
    "edges/ros/test_edge.py",
    "edges/tcp/test_edge.py",
    "replay/test_verify.py",
    "test_architecture.py",
    "record/sessionfile/test_reader.py",
    "record/sessionfile/test_lookup.py",
    "addons/view/test_verb.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Each worker begins its collection at another file: in a new checkout, what one compiles the others only read."""
    own: dict[str, Any] | None = getattr(config, "workerinput", None)
    if own is None or config.args != config.getini("testpaths"):
        return
    files = sorted(str(path) for path in Path(__file__).parent.rglob("test_*.py"))
    at = len(files) * int(own["workerid"].removeprefix("gw")) // own["workercount"]
    config.args[:] = [*files[at:], *files[:at]]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Keeps pytest's own lines as wide as they are without COLUMNS."""
    if reporter := session.config.pluginmanager.getplugin("terminalreporter"):
        reporter._tw.fullwidth = 120


def pytest_collection_finish() -> None:
    """Leaves what stays until the end out of Python's collections."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, object, object]:
    """Collects at the end of a file, and leaves what stays out of later collections.

    By itself Python would rarely look at all objects: what refers to itself, such as closed bridges and types of
    messages, would grow to two gigabytes, and looking at these takes seconds.
    """
    result = yield
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
        gc.freeze()
    return result


@pytest.hookimpl(tryfirst=True)  # before pytest selects by -m
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks the second and the third tier.  They start with the longest files.  ``ros`` is skipped without ROS 2."""
    here = Path(__file__).parent
    slow = {here / name for name in SLOW}
    for item in items:
        if item.path in slow:
            item.add_marker(pytest.mark.slow)
        if item.nodeid.removeprefix("tests/").startswith(LONG):
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.long)
    if hasattr(config, "workerinput"):
        rank = {here / name: number for number, name in enumerate(LONGEST)}
        items.sort(key=lambda item: (rank.get(item.path, len(rank)), item.path))
    if find_spec("rclpy") is not None:
        return
    absent = pytest.mark.skip(reason="no ROS 2 here: install the extra 'ros' or source a ROS 2")
    for item in items:
        if "ros" in item.keywords:
            item.add_marker(absent)


_deaths: list[object] = []


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(error: object | None) -> None:
    """A worker of xdist has ended: if it crashed, some of its tests have not run."""
    if error:
        _deaths.append(error)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """A crashed worker makes the run invalid; that is not the same as a failed test, which might pass alone."""
    if _deaths:
        session.exitstatus = pytest.ExitCode.INTERNAL_ERROR


@pytest.fixture(autouse=True)
def patient_limits() -> Iterator[None]:
    """Reading a file may take longer than for users: beside four other tests a limit of 20 s hid what was wrong."""
    with limits_in_force(FileLimits(seconds=MOST_READING_S)):
        yield


@pytest.fixture
def terminal_signals() -> Iterator[None]:
    """The signals of a terminal end a program, here and in the programs that a test starts: ``nohup`` and a shell that
    starts something in the background have it ignore them, and so would all of its children.
    """
    numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT)
    ignored = [number for number in numbers if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.default_int_handler if number is signal.SIGINT else signal.SIG_DFL)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(autouse=True)
def _no_streams_left() -> Iterator[None]:
    """rerun keeps the thread of every recording stream until it is asked to remove the unreferenced ones."""
    yield
    if rerun := sys.modules.get("rerun"):
        rerun.bindings.flush_and_cleanup_orphaned_recordings()
