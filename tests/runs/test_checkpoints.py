"""What a run leaves behind are weights and plain values: no file has to be trusted to be read."""

from __future__ import annotations

import resource
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.runs.checkpoints import load, save, weights_sha256
from tests.fixtures.harm import Harm

KINDS = {"last.ckpt", "result.pt", "student.pt", "warmup_last.pt", "warmup_selected.pt"}


def test_every_file_loads_without_unpickling_objects(finished):
    files = [path for path in finished.rglob("*") if path.suffix in (".pt", ".ckpt")]
    assert {path.name for path in files} >= KINDS
    added = torch.serialization.get_safe_globals()  # by torch and by torch-geometric, for theirs
    torch.serialization.clear_safe_globals()
    try:
        for path in files:
            assert torch.load(path, map_location="cpu", weights_only=True)
    finally:
        torch.serialization.add_safe_globals(added)


def test_a_hash_does_not_depend_on_the_order():
    """Of which safetensors makes another one each time that it reads a file."""
    weights = {"a.weight": torch.arange(6.0).view(2, 3), "a.bias": torch.ones(2)}
    sha256 = weights_sha256(weights)
    assert sha256 == weights_sha256(dict(reversed(weights.items())))
    assert sha256 != weights_sha256(weights | {"a.bias": torch.zeros(2)})
    assert sha256 != weights_sha256({"b.bias": torch.ones(2), "a.weight": weights["a.weight"]})


def test_student_result_and_checkpoint_have_the_same_weights(finished):
    student = torch.load(finished / "student.pt", weights_only=True)
    result = torch.load(finished / "result.pt", weights_only=True)["weights"]
    last = torch.load(finished / "last.ckpt", weights_only=True)["state_dict"]
    assert set(result) == set(student)
    for name, value in student.items():
        assert torch.equal(result[name], value)
        assert torch.equal(last[f"net.{name}"], value)


@pytest.mark.parametrize("best", [np.float64(0.5), Path("a")])
def test_what_could_not_be_read_again_is_not_written(best, tmp_path):
    """A run with such a callback of somebody's own could not go on after an interruption."""
    file = tmp_path / "last.ckpt"
    save({"epoch": 3}, file)
    with pytest.raises(ConfigError):
        save({"w": torch.zeros(2), "callbacks": {"Best": {"of": [0.25, best]}}}, file)
    assert load(file) == {"epoch": 3}
    assert list(tmp_path.iterdir()) == [file]


def test_a_flipped_bit_anywhere_is_noticed_or_changes_nothing(tmp_path):
    """Every sixth byte is tried; torch alone takes flips in the weights for other weights."""
    file = tmp_path / "a.pt"
    value = {"epoch": 3, "w": torch.arange(6.0)}
    save(value, file)
    data, read, blind = file.read_bytes(), 0, 0
    for place in range(1, len(data), 6):
        flipped = bytearray(data)
        flipped[place] ^= 1 << place % 8
        file.write_bytes(flipped)
        try:
            found = load(file)
        except DataError:
            continue
        read += 1
        assert found.keys() == value.keys()
        assert found["epoch"] == 3
        assert torch.equal(found["w"], value["w"])
    assert 0 < read < len(data) / 12  # times, padding
    weights = data.index(value["w"].numpy().tobytes())
    for place in range(weights, weights + 24):
        flipped = bytearray(data)
        flipped[place] ^= 1
        file.write_bytes(flipped)
        blind += not torch.equal(torch.load(file, weights_only=True)["w"], value["w"])
        with pytest.raises(DataError, match=r"a\.pt"):
            load(file)
    assert blind == 24  # or torch has learnt it, and ours can go


def test_nothing_is_unpickled(tmp_path):
    torch.save({"w": torch.zeros(9), "harm": Harm(tmp_path / "harm")}, tmp_path / "a.pt")
    with pytest.raises(DataError, match="Weights only"):
        load(tmp_path / "a.pt")
    assert not (tmp_path / "harm").exists()


def test_a_full_disk_is_told_in_words(tmp_path):
    """The kernel refuses files of more than 50 kB."""
    path = tmp_path / "a.pt"
    save({"w": torch.zeros(9)}, path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, before[1]))
        with pytest.raises(Qs3Error, match=r"a\.pt"):
            save({"w": torch.zeros(100_000)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert len(load(path)["w"]) == 9  # the old file
    assert list(tmp_path.iterdir()) == [path]
