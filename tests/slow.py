"""What `make test` leaves to `make test-all`, beside the tests that are marked where they stand.

Patterns of test ids with the seconds of processor time that they took together when the list was
made. Of each family a quick member stays: one net, one experiment, one table.
"""

from __future__ import annotations

import re

PATTERNS = (
    # Every table in every format: composing all cells of all tables.
    r"report/tables/test_formats\.py::test_every_table_in_every_format\[(?!quickstart)",
    r"report/tables/test_formats\.py::test_(how_published|averages|an_average|what_is_published|simulated_targets|a_published_acc|published_av)",
    r"report/tables/test_running\.py::test_(compare_by_hand|effects_by_hand|what_a_table_does_not_average|objects_that)",
    r"report/tables/test_running\.py::test_(only_what_is_missing|one_cell|a_failure_is)",
    r"report/tables/test_tables\.py::test_(every_cell_composes|another_target|paper_beside)",
    r"engine/test_rows\.py::.*\[uda self_training",
    # Real sweeps and searches of several processes.
    r"sweeps/test_search\.py::test_(it_finds|a_run_that_diverged|the_grid_is)",
    r"sweeps/test_launchers\.py::",
    r"training/test_command\.py::test_(multirun_then|ddp_is_refused|missing_data_in_a_multirun)",
    r"training/test_ddp\.py::",
    # The large nets; the small ones take the same code.
    r"models/test_all_nets\.py::.*\[(simpleview|pointnet2|pointnet2_ssg|rscnn)",
    r"models/test_rscnn\.py::test_(equals_straight_network\[True|float32_error)",
    r"models/test_all_norms\.py::.*\[(simpleview|pointnet2)",
    r"models/test_(simpleview|pointnet2|rscnn)\.py::test_numbers_of_",
    # Exports: one net in each format stays.
    r"inference/test_export\.py::test_onnxruntime_gives_the_net_s_logits\[(?!pointnet\])",
    r"inference/test_export\.py::test_torch_export_gives_the_net_s_logits\[(?!pointnet\])",
    r"inference/test_export\.py::test_(the_command_and|the_example|one_cloud_to)",
    r"test_notebooks\.py::test_0",
    r"test_experiments\.py::test_experiment_runs\[(?!qs3_s2d|supervised_d|own_scans)",
    r"data/inspection/test_measures\.py::test_inspect_says_and_saves",
    r"data/test_gravity_axis\.py::test_the_(embedded_catalogue|real_modelnet10|model_on_disk)",
    r"data/inspection/test_measures\.py::test_compare_says_and_saves",
    r"sensors/bench/test_bench\.py::test_simulated_tables",
    r"sensors/bench/test_presets\.py::test_a_preset_holds_its_bands\[(?!kinect_v1)",
    r"sensors/renderers/test_renderers\.py::test_memory_does_not_grow\[blender",
    r"sensors/renderers/test_agreement_paper\.py::.*\[(?!chair|table)",
    r"sensors/fit/test_fit\.py::test_(hidden_parameters|noise_far_below|holes_of_any_size|a_lens_that)",
    r"sensors/fit/test_fit\.py::test_(walls_that_face|other_things_before|whole_millimetres|real_kinect)",
    r"report/runs/test_pictures\.py::test_(offline_wandb|command_line|files_and_page|missing_round|unlabelled)",
    r"training/test_fit\.py::test_seed_1_alone",
    r"generation/test_(disk|blensor|forty_classes)\.py::",
    r"data/test_contact_sheets\.py::test_command_line",
    r"selftraining/test_learning\.py::test_(crst|confidence_chooses|cbst_does|qbst_s_balance_costs)",
    r"generation/test_provenance\.py::test_views_are_the_same_bytes",
    r"generation/test_workers\.py::test_if_every_object_kills",
    r"generation/test_command\.py::test_if_all_fail",
    r"generation/test_mesh_variants\.py::test_a_thin_lamp",
    r"generation/released/test_poses\.py::test_all_released_poses",
    r"sensors/devices/test_every_sensor\.py::test_both_renderers_give_the_same_depth\[fringes",
    r"models/test_simpleview\.py::test_float32_error",
    r"models/test_all_norms\.py::test_exact_adabn.*\[pointdan",
    r"inference/test_export\.py::test_a_net_of_one_s_own_is_exported_as_it_is",
    # One or two of each family stay.
    r"methods/test_steps\.py::test_(operations_do|no_value).*\[(?!pcm\]|gast\]|student\]|dann\]|supervised\])",
    r"data/test_domain\.py::test_missing_data_is_explained\[(?!depthscannet10\]|modelnet10\]|specklenet10\]|own\])",
    r"data/test_domain\.py::test_every_domain_opens.*\[(?!depthscannet10|modelnet10\]|specklenet10\]|scannet10\]|own|nyuv2)",
    r"report/tables/test_tables\.py::test_(the_papers_numbers|cells_differ|quickstart_filled|extra_over)",
    r"report/tables/test_formats\.py::test_failed_seeds",
    r"report/tables/test_made_of\.py::test_(sources_of|rows_are)",
    r"test_experiments\.py::test_experiment_runs\[own_scans",
    r"training/test_command\.py::test_every_experiment_composes",
    r"training/test_student_selection\.py::test_.*\[(infomax\]|snd\]|infomax-|pseudo_val\])",
    r"training/test_resume\.py::test_interrupted_in_a_hook\[(on_train_batch_end-17|on_train_epoch_end-10|on_validation)",
    r"training/test_resume\.py::test_interrupted_while_a_checkpoint_is_written\[(5|6)\]",
    r"training/test_(protocols\.py::test_a_run_with_a_plateau|debugging\.py::test_ckpt_path_(warns|brings))",
    r"utils/test_cli\.py::test_a_reader_that_has_seen_enough.*\[words[123]",
    r"meshes/test_catalogue_objects\.py::test_parts_are_solids.*\[(?!chair|lamp|bed)",
    r"meshes/test_catalogue_objects\.py::test_(no_part|equal_keys).*\[(?!chair|lamp|bed|sofa|table)",
    r"generation/test_command\.py::test_(parts_without|fewer_objects|a_repaired)",
    r"generation/test_generate_configs\.py::test_(source_and_stand_in|help_says)",
    r"generation/test_mesh_variants\.py::test_the_same_object.*\[inverted",
    r"generation/released/test_released\.py::test_keys_can_be_given_alone\[(?!crop)",
    r"generation/released/test_poses\.py::test_the_released_cameras",
    r"sensors/renderers/test_renderers\.py::test_.*\[(mitsuba_scalar|blender-(2|window[12]))",
    r"sensors/renderers/test_renderers\.py::test_(threads_do_not|fresh_process).*\[blender",
    r"sensors/matching/test_matching_in_sensors\.py::test_planes_of_a_stereo.*\[(correlation|block)",
    r"sensors/matching/test_census\.py::test_no_phase.*texture[12]",
    r"sensors/devices/test_every_sensor\.py::test_the_proj.*\[(?!stereo|reference|time)",
    r"sensors/devices/test_fringe\.py::test_(noise_and_bias.*\[(70|two|220\.0-above)|samples_do)",
    r"sensors/bench/test_bench\.py::test_the_command_writes",
    r"report/figures/test_pipeline\.py::test_(other_sensors_say.*\[(time|blensor)|a_dataset_that_kept)",
    r"report/runs/test_pictures\.py::test_stale",
    r"report/runs/test_clouds\.py::test_a_config_without_domains.*\[data",
    r"data/frames/test_real_kinect\.py::test_two_ways",
    r"data/scannet/test_extraction\.py::test_other_files",
    r"data/test_gravity_axis\.py::test_every_published",
    r"models/test_simpleview\.py::test_windows_change",
)

_SLOW = re.compile("|".join(PATTERNS))


def is_slow(nodeid: str) -> bool:
    """Whether the test of this id is one of them."""
    return _SLOW.search(nodeid) is not None
