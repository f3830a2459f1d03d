"""What a run leaves behind are weights and plain values: no file has to be trusted to be read."""

from __future__ import annotations

import torch

from tests.training.conftest import finished, toy_data  # noqa: F401 (fixtures)

KINDS = {"last.ckpt", "result.pt", "student.pt", "warmup_last.pt", "warmup_selected.pt"}


def test_every_file_loads_without_unpickling_objects(finished):  # noqa: F811
    files = [path for path in finished.rglob("*") if path.suffix in (".pt", ".ckpt")]
    assert {path.name for path in files} >= KINDS
    added = torch.serialization.get_safe_globals()  # by torch and by torch-geometric, for theirs
    torch.serialization.clear_safe_globals()
    try:
        for path in files:
            assert torch.load(path, map_location="cpu", weights_only=True)
    finally:
        torch.serialization.add_safe_globals(added)


def test_the_student_s_weights_are_those_of_the_result_and_of_the_last_checkpoint(finished):  # noqa: F811
    student = torch.load(finished / "student.pt", weights_only=True)
    result = torch.load(finished / "result.pt", weights_only=True)["weights"]
    last = torch.load(finished / "last.ckpt", weights_only=True)["state_dict"]
    assert set(result) == set(student)
    for name, value in student.items():
        assert torch.equal(result[name], value)
        assert torch.equal(last[f"net.{name}"], value)
