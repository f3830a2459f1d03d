"""What `make test` leaves to `make test-all`, beside the tests that are marked where they stand.

Patterns of test ids with the seconds of processor time that they took together when the list was
made. Of each family a quick member stays: one net, one experiment, one table.
"""

from __future__ import annotations

import re

PATTERNS = (
    # Every table in every format: composing all cells of all tables.
    # Damaged files of runs: whole trainings around them.
    # Real sweeps and searches of several processes.
    r"sweeps/test_search\.py::test_(it_finds|a_run_that_diverged|the_grid_is)",
    r"sweeps/test_launchers\.py::",
    # The large nets; the small ones take the same code.
    # Exports: one net in each format stays.
    r"test_notebooks\.py::test_0",
    # What takes seconds and whose parts have tests of their own.
    r"test_api\.py::test_train_leaves_what_the_command_leaves",
    # One or two of each family stay.
    r"datasets/test_domain\.py::test_missing_data_is_explained\[(?!depthscannet10\]|modelnet10\]|specklenet10\]|own\])",
    r"datasets/test_domain\.py::test_every_domain_opens.*\[(?!depthscannet10|modelnet10\]|specklenet10\]|scannet10\]|own|nyuv2)",
    r"utils/test_cli\.py::test_a_reader_that_has_seen_enough.*\[words[123]",
    r"datasets/frames/test_real_kinect\.py::test_two_ways",
    # Further members of families that the quick run knows by one or two.
    r"datasets/test_domain\.py::test_every_domain_opens.*\[nyuv2",
    r"datasets/frames/test_(our_sensors\.py::test_(clouds_lie|what_was_placed)|real_kinect\.py::test_what_lies)",
    r"datasets/frames/test_nyuv2\.py::test_(the_same_again|other_settings|other_processes)",
    r"datasets/frames/test_sunrgbd\.py::test_a_box_that_is_none",
    r"sweeps/test_document\.py::test_command_composes\[python train",
    r"utils/test_pool\.py::test_processes_end_with_their_parent.*\[SIGINT",
    # What trains, renders or starts processes, and has a smaller relative in the quick run.
    r"sweeps/test_search\.py::test_(the_objective_is|what_is_refused\[(?!objective)|configs_are.*optuna)",
    r"utils/test_pool\.py::test_(a_worker_that_cannot|processes_are_replaced)",
    r"datasets/frames/test_sunrgbd\.py::test_the_raw_depth",
    r"datasets/frames/test_nyuv2\.py::test_an_interrupted_import",
    r"datasets/test_ensure_source\.py::test_a_missing_source_is_made",
    r"config/test_quoting\.py::test_every_path_of_ours",
    r"datasets/test_domain\.py::test_processes_that_open",
    r"datasets/importers/test_importers\.py::test_(kill_9|npy_header_damaged)",
    # What grew since: one of each family stays. Committed tables are composed by others, too.
    # What had grown since, or takes longer than the parts that stay.
)

_SLOW = re.compile("|".join(PATTERNS))


def is_slow(nodeid: str) -> bool:
    """Whether the test of this id is one of them."""
    return _SLOW.search(nodeid) is not None
