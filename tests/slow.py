"""What `make test` leaves to `make test-all`, beside the tests that are marked where they stand.

Patterns of test ids with the seconds of processor time that they took together when the list was
made. Of each family a quick member stays: one net, one experiment, one table.
"""

from __future__ import annotations

import re

PATTERNS = (
    # Every table in every format: composing all cells of all tables.
    r"engine/test_rows\.py::.*\[uda self_training",
    # Damaged files of runs: whole trainings around them.
    r"training/test_resume\.py::test_damaged_tables_are_named",
    r"training/test_shared_warmup\.py::test_a_flipped_bit_is_trained_again",
    # Real sweeps and searches of several processes.
    r"sweeps/test_search\.py::test_(it_finds|a_run_that_diverged|the_grid_is)",
    r"sweeps/test_launchers\.py::",
    r"training/test_command\.py::test_(multirun_then|ddp_is_refused|missing_data_in_a_multirun)",
    r"training/test_ddp\.py::",
    # The large nets; the small ones take the same code.
    # Exports: one net in each format stays.
    r"inference/test_export\.py::test_onnxruntime_gives_the_net_s_logits\[(?!pointnet\])",
    r"inference/test_export\.py::test_torch_export_gives_the_net_s_logits\[(?!pointnet\])",
    r"inference/test_export\.py::test_(the_command_and|the_example)",
    r"test_notebooks\.py::test_0",
    r"test_experiments\.py::test_experiment_runs\[(?!qs3_s2d|supervised_d|own_scans)",
    r"training/test_fit\.py::test_seed_1_alone",
    r"generation/test_(disk|blensor|forty_classes)\.py::",
    r"selftraining/test_learning\.py::test_(crst|confidence_chooses|cbst_does|qbst_s_balance_costs)",
    r"generation/test_provenance\.py::test_views_are_the_same_bytes",
    r"generation/test_workers\.py::test_if_every_object_kills",
    r"generation/test_command\.py::test_if_all_fail",
    r"generation/test_mesh_variants\.py::test_a_thin_lamp",
    r"generation/released/test_poses\.py::test_all_released_poses",
    r"inference/test_export\.py::test_a_net_of_one_s_own_is_exported_as_it_is",
    # What takes seconds and whose parts have tests of their own.
    r"test_api\.py::test_train_leaves_what_the_command_leaves",
    r"generation/test_room_scans\.py::test_fronts_are_seen_as_often",
    r"generation/test_arrangements\.py::test_real_chairs_do_not_go",
    r"datamodules/test_batches\.py::test_pieces_of_a_way",
    r"meshes/test_catalogue\.py::test_the_same_meshes_in_another_process",
    r"training/test_target_labels\.py::test_the_upper_bound_does",
    r"training/test_frozen_features\.py::test_a_run_is_computed_once",
    r"training/test_own_method\.py::test_on_a_target_without",
    # One or two of each family stay.
    r"datasets/test_domain\.py::test_missing_data_is_explained\[(?!depthscannet10\]|modelnet10\]|specklenet10\]|own\])",
    r"datasets/test_domain\.py::test_every_domain_opens.*\[(?!depthscannet10|modelnet10\]|specklenet10\]|scannet10\]|own|nyuv2)",
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
    r"datasets/frames/test_real_kinect\.py::test_two_ways",
    r"datasets/scannet/test_extraction\.py::test_other_files",
    # Further members of families that the quick run knows by one or two.
    r"test_experiments\.py::test_experiment_runs\[supervised_d",
    r"test_composing\.py::test_it_is_what_hydra_composes\[(?!a toy run|another scheme|no command)",
    r"datasets/test_domain\.py::test_every_domain_opens.*\[nyuv2",
    r"datasets/frames/test_(our_sensors\.py::test_(clouds_lie|what_was_placed)|real_kinect\.py::test_what_lies)",
    r"datasets/frames/test_nyuv2\.py::test_(the_same_again|other_settings|other_processes)",
    r"datasets/frames/test_sunrgbd\.py::test_a_box_that_is_none",
    r"generation/test_made_of\.py::test_(it_names_meshes|all_of_modelnet40)",
    r"generation/test_mesh_variants\.py::test_(an_open_surface|other_objects)",
    r"generation/test_provenance\.py::test_what_is_kept",
    r"generation/released/test_(poses\.py::test_the_released_poses|released\.py::test_the_views)",
    r"meshes/test_damaged_files\.py::test_(cut|flipped).*\[(a\.dae|a\.gltf|a\.off|a\.stl|ascii)",
    r"selftraining/test_learning\.py::test_qbst_s_balance_helps",
    r"sweeps/test_document\.py::test_command_composes\[python train",
    r"training/test_command\.py::test_what_is_missing.*\[words[23]",
    r"training/test_debugging\.py::test_(overfit|profiler.*\[PyTorch)",
    r"training/test_unlabelled_target\.py::test_table_of",
    r"utils/test_pool\.py::test_processes_end_with_their_parent.*\[SIGINT",
    # What trains, renders or starts processes, and has a smaller relative in the quick run.
    r"generation/test_room_scans\.py::test_what_a_depth_edge_tears",
    r"generation/test_workers\.py::test_(a_renderer_that_cannot|failures_of_objects.*\[2)",
    r"generation/test_generate_configs\.py::test_(help_is_short|scene_tracking.*\[kinectsim10|every_domain_has.*\[(blensor|specklenet10_|modelnet10_d))",
    r"generation/released/test_poses\.py::test_generate_follows",
    r"inference/test_export\.py::test_onnxruntime_gives",
    r"selftraining/test_learning\.py::test_students_surpass",
    r"training/test_resume_schemes\.py::test_every_scheme.*\[(random|crst_lrent|spst)",
    r"training/test_resume_schemes\.py::test_every_method.*\[(gast|pointdan)",
    r"training/test_resume\.py::test_interrupted_in_a_hook\[(on_train_batch_end-7|on_train_epoch_end-4|on_train_end)",
    r"training/test_resume\.py::test_interrupted_in_a_function\[.*(predict-2|check_selection)",
    r"training/test_resume\.py::test_interrupted_while_a_checkpoint_is_written\[(4|10)\]",
    r"training/test_target_labels\.py::test_no_target_label.*\[settings(2-True|4-False|7-False)",
    r"training/test_shared_warmup\.py::test_(another_warmup|a_damaged_mark)",
    r"training/test_student_selection\.py::test_(interrupted|soft_pseudo|a_rule_without|a_score_that)",
    r"training/test_unlabelled_target\.py::test_(reports_of|own_scans.*more0|without_a_test_split.*True)",
    r"training/test_phases\.py::test_the_optimiser_begins_anew\[continued",
    r"sweeps/test_search\.py::test_(the_objective_is|what_is_refused\[(?!objective)|configs_are.*optuna)",
    r"utils/test_pool\.py::test_(a_worker_that_cannot|processes_are_replaced)",
    r"engine/test_checkpointing\.py::test_a_shared_warmup_counts",
    r"datasets/frames/test_sunrgbd\.py::test_the_raw_depth",
    r"datasets/frames/test_nyuv2\.py::test_an_interrupted_import",
    r"datasets/test_ensure_source\.py::test_a_missing_source_is_made",
    r"datasets/scannet/test_extraction\.py::test_(force_starts|the_number_of_workers|an_object_that_is_nowhere)",
    r"datasets/scannet/test_masks\.py::test_a_zip_cannot",
    r"evaluation/test_accuracy_estimates\.py::test_a_run_on_one_s_own",
    r"meshes/test_folder\.py::test_real_meshes",
    r"meshes/test_catalogue\.py::test_two_seeds_share",
    r"config/test_quoting\.py::test_every_path_of_ours",
    r"generation/test_provenance\.py::test_(every_point|asking_for)",
    r"generation/test_command\.py::test_the_number_of_workers",
    r"generation/test_contact_sheets\.py::test_a_finished",
    r"meshes/test_catalogue\.py::test_(the_same_meshes|more_objects)",
    r"datasets/test_domain\.py::test_processes_that_open",
    r"datasets/importers/test_importers\.py::test_(kill_9|npy_header_damaged)",
    r"inference/test_predictor\.py::test_written_is_read",
    r"evaluation/test_ood\.py::test_limits_take",
    # What grew since: one of each family stays. Committed tables are composed by others, too.
    r"training/test_debugging\.py::test_nothing_about_clouds.*\[(?!qs3_s2d\]|own_scans\]|leaderboard\])",
    r"training/test_target_labels\.py::test_no_target_label.*\[settings1",
    r"training/test_command\.py::test_what_is_missing.*\[words([5-8]|1[0-35-9])-",
    r"generation/test_command\.py::test_(files_of_a_size|one_split.*\[test)",
    r"generation/test_generate_configs\.py::test_so_does_the_one",
    r"generation/test_generate_configs\.py::test_every_key.*\[(?!specklenet10\]|kinectsim10\]|roomscan10)",
    r"generation/test_depth_errors\.py::test_every_row",
    r"test_docs\.py::test_the_example_of_gradients",
    # What had grown since, or takes longer than the parts that stay.
    r"training/test_cuda_graphs\.py::test_a_run_is_the_same_with_graphs\[method0",
    r"training/test_command\.py::test_a_start_that_fails",
    r"inference/test_trusted\.py::test_(norms_of_each_domain_are|of_norms_that_follow)",
    r"generation/test_twins\.py::test_asking_for_twins",
    r"training/test_code\.py::test_a_warm_up_of_a_net_that_was_edited",
    r"training/test_fit\.py::test_classes_that_nothing_teaches.*\[train_clouds[12]",
    r"training/test_debugging\.py::test_a_warm_up_of_two_versions.*\[changed[13]",
    r"inference/test_draw\.py::test_a_sample_is",
)

_SLOW = re.compile("|".join(PATTERNS))


def is_slow(nodeid: str) -> bool:
    """Whether the test of this id is one of them."""
    return _SLOW.search(nodeid) is not None
