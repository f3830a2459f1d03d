"""A classifier's folder gives it back to the last bit, and nothing that was damaged or made up."""

import json
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import qs3
from qs3.errors import DataError
from qs3.inference import pretrained
from qs3.inference.export import export_folder
from qs3.inference.judgement import Interval, Judgement, Tier
from qs3.inference.model_card import card, carried, wilson
from qs3.inference.model_file import read_result
from qs3.inference.tensor_file import read_tensors, write_tensors
from qs3.runs.metrics import read_metrics
from tests.running import main

FILES = ["README.md", "config.json", "held_out.safetensors", "model.safetensors"]
TYPES = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32,
    torch.int16, torch.int8, torch.uint8, torch.bool,
)  # fmt: skip


def file_of(header, body=b""):
    """Bytes by the format's description."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


def entry(dtype="F32", shape=(2,), offsets=(0, 8)):
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported") / "model"
    export_folder(run, folder)
    return folder


@pytest.fixture
def folder(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "model")


def edited(folder, **values):
    about = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(about | values))
    return folder


def test_a_file_by_hand(tmp_path):
    body = struct.pack("<2f", 1.5, -2) + b"\x01\x00"
    header = {
        "__metadata__": {"format": "pt"}, "b": entry("BOOL", [2, 1], [8, 10]), "a": entry(),
    }  # fmt: skip
    found = read_tensors(file_of(header, body), tmp_path)
    assert torch.equal(found["a"], torch.tensor([1.5, -2]))
    assert torch.equal(found["b"], torch.tensor([[True], [False]]))
    write_tensors(tmp_path / "w", found, {"format": "pt"})
    data = (tmp_path / "w").read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    assert length % 8 == 0
    assert json.loads(data[8 : 8 + length]) == json.loads(json.dumps(header))
    assert data[8 + length :] == body


@settings(max_examples=20)
@given(
    st.dictionaries(
        st.text(min_size=1).filter(lambda name: name != "__metadata__"),
        st.tuples(st.sampled_from(TYPES), st.lists(st.integers(0, 4), max_size=3)),
        max_size=5,
    )
)
def test_what_is_written_is_read(tmp_path_factory, wanted):
    path = tmp_path_factory.getbasetemp() / "a.safetensors"
    torch.manual_seed(0)
    tensors = {name: (9 * torch.randn(shape)).to(kind) for name, (kind, shape) in wanted.items()}
    write_tensors(path, tensors, {})
    data = path.read_bytes()
    found = read_tensors(data, path)
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)
    write_tensors(path, dict(reversed(tensors.items())), {})
    assert path.read_bytes() == data


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "cut off"),
        (b"\x01" * 7, "cut off"),
        (struct.pack("<Q", 1 << 62) + b"{}", "names a header of"),
        (file_of({"a": entry()}, bytes(7)), "expected 8 of them"),
        (file_of({"a": entry()}, bytes(9)), "a ends at 8, the end begins at 9"),
        (file_of({"a": entry(offsets=(4, 12))}, bytes(12)), "the beginning ends at 0"),
        (file_of({"a": entry(), "b": entry(offsets=(4, 12))}, bytes(12)), "begins at 4"),
        (file_of({"a": entry(), "b": entry()}, bytes(8)), "begins at 0"),
        (file_of({"a": entry(shape=[1 << 40, 1 << 40])}, bytes(8)), "expected"),
        (file_of({"a": entry(shape=[-2, -1])}, bytes(8)), "whole numbers"),
        (file_of({"a": entry(shape=[True, 2])}, bytes(8)), "whole numbers"),
        (file_of({"a": entry(shape=[2.0])}, bytes(8)), "whole numbers"),
        (file_of({"a": entry(shape=[1] * 17, offsets=(0, 4))}, bytes(4)), "whole numbers"),
        (file_of({"a": entry(shape="2")}, bytes(8)), "whole numbers"),
        (file_of({"a": entry(shape=[0, 10**30], offsets=(0, 0))}), "whole numbers"),
        (file_of({"a": entry(shape=[0, 1 << 62, 4], offsets=(0, 0))}), "whole numbers"),
        (file_of({"a": entry(shape=[0, *[1 << 30] * 15], offsets=(0, 0))}), "whole numbers"),
        (file_of({"a": entry(shape=[0], offsets=(10**30, 10**30))}), "expected 0 of them"),
        (file_of({"a": entry(dtype="F8")}, bytes(8)), "dtype of F64"),
        (file_of({"a": entry(dtype=["F32"])}, bytes(8)), "dtype of F64"),
        (file_of({"a": entry(offsets=(8,))}, bytes(8)), "data_offsets"),
        (file_of({"a": entry(offsets=(8, 0))}, bytes(8)), "expected"),
        (file_of({"a": []}), "data_offsets"),
        (file_of(b"[1]"), "not a JSON object"),
        (file_of(b'{"a": 1, "a": 2}'), "occurs twice"),
        (file_of(b"[" * 100_000), "header is not as it should be"),
        (file_of(b'{"a": ' + b"1" * 10_000 + b"}"), "header is not as it should be"),
        (file_of(b"\xff\xfe\x00"), "header is not as it should be"),
    ],
)  # fmt: skip
def test_damaged_files_are_named(tmp_path, data, message):
    with pytest.raises(DataError, match=message) as error:
        read_tensors(data, tmp_path / "x.safetensors")
    assert str(error.value).startswith(str(tmp_path / "x.safetensors"))


def test_the_folder_gives_the_run_s_classifier_back(run, folder, tmp_path):
    assert sorted(path.name for path in folder.iterdir()) == FILES
    ours, theirs = read_result(run), read_result(folder)
    for key, value in vars(ours).items():
        if key not in ("weights", "held_out"):  # tensors
            assert getattr(theirs, key) == value, key
    clouds = np.random.default_rng(0).normal(size=(5, 90, 3))
    np.testing.assert_array_equal(qs3.load(folder)(clouds), qs3.load(run)(clouds))
    np.save(tmp_path / "clouds.npy", clouds)
    out = tmp_path / "said.csv"
    words = [f"input={tmp_path / 'clouds.npy'}", f"out={out}", "page=false"]
    assert main(["predict", f"ckpt={folder}", *words]) == 0
    said = out.read_text()
    assert main(["predict", f"ckpt={run}", *words]) == 0
    assert out.read_text() == said
    assert ours.weights.keys() == theirs.weights.keys()
    for name, tensor in ours.weights.items():
        assert torch.equal(tensor, theirs.weights[name])


def test_any_flipped_byte_or_cut_of_the_weights_is_refused(folder):
    path = folder / "model.safetensors"
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for at in (0, 9, len(data) - 1, *rng.integers(0, len(data), 7)):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :])
        with pytest.raises(DataError, match=r"model\.safetensors is damaged"):
            read_result(folder)
    for size in (0, 7, 8, 100, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(DataError, match=r"model\.safetensors is damaged"):
            qs3.load(folder)
    path.write_bytes(data)
    qs3.load(folder)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"weights_sha256": None}, "SHA-256"),
        ({"points": 0}, "points"),
        ({"points": 1.5}, "points"),
        ({"classes": ["a", "a"]}, "classes"),
        ({"usual": {"height": [None]}}, "usual"),
        ({"usual": {"height": ["low", None]}}, "usual"),
        ({"usual": [1]}, "usual"),
        ({"learnt": [0.5, 0.5]}, "learnt"),
        ({"learnt": [0.5, 0.5, 0.0]}, "learnt"),
        ({"learnt": [0.5, 0.5, float("nan")]}, "learnt"),
        ({"learnt": 1}, "learnt"),
        ({"model": {"_target_": "os.mkdir", "path": "was_run"}}, "refused"),
        ({"model": {"_target_": "qs3.models.os.mkdir", "path": "was_run"}}, "not in this"),
        ({"model": {"_target_": "qs3.models.dgcnn.dgcnn", "num_classes": 4}}, "weights"),
    ],
    ids=str,
)
def test_config_json_is_not_trusted(folder, tmp_path, monkeypatch, values, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=message):
        qs3.load(edited(folder, **values))
    assert not (tmp_path / "was_run").exists()


@pytest.mark.parametrize(
    "text", ["", "[1]", "{", "[" * 100_000, '{"points": ' + "1" * 10_000 + "}", " " * (2 << 20)]
)
def test_a_damaged_config_is_named(folder, text):
    (folder / "config.json").write_text(text)
    with pytest.raises(DataError, match=r"config\.json"):
        qs3.load(folder)
    (folder / "config.json").unlink()
    with pytest.raises(DataError, match=r"config\.json cannot be read"):
        qs3.load(folder)


def test_the_card_says_what_the_run_knows(run, folder, tmp_path):
    text, metrics = (folder / "README.md").read_text(), read_metrics(run)
    _, front, body = text.split("---\n", 2)
    assert yaml.safe_load(front)["library_name"] == "qs3"
    final = metrics.final
    low, high = wilson(round(final.accuracy * final.n), final.n)
    assert f"On {final.n} test clouds of kinectsim10 (simulated): {final.accuracy:.1%}" in body
    assert f"{low:.1%} to {high:.1%}" in body
    for words in (metrics.config_sha256, metrics.data.source, "ball, rod, slab", "(simulated)"):
        assert words in body
    alone = tmp_path / "sent.pt"
    alone.write_bytes((run / "result.pt").read_bytes())
    export_folder(alone, tmp_path / "other")
    other = (tmp_path / "other" / "README.md").read_text()
    assert "%" not in other
    assert "Not recorded" in other


def test_figures_that_were_told_something_say_so(run):
    result, metrics = read_result(run), read_metrics(run)
    assert "prior" not in card(result, metrics)
    told = replace(metrics.evaluation, prior="classes count as this common: rod 90.0%")
    text = card(result, replace(metrics, evaluation=told))
    assert "That is with `evaluation.prior`: classes count as this common" in text
    assert "Without `prior=` of `qs3.load`" in text
    camera = card(replace(result, gravity="none"), metrics)
    assert "z forward" in camera
    assert "z up" not in camera


def test_a_copy_of_an_exported_folder_keeps_its_card(run, folder, tmp_path):
    card = (folder / "README.md").read_text()
    export_folder(folder, tmp_path / "copy", half=True)
    assert (tmp_path / "copy" / "README.md").read_text() == card
    export_folder(pretrained.FOLDER / pretrained.ANY_SIZE, tmp_path / "own")
    ours = (tmp_path / "own" / "README.md").read_text()
    assert ours == (pretrained.FOLDER / pretrained.ANY_SIZE / "README.md").read_text()
    assert "Not recorded" not in ours
    copy = shutil.copytree(folder, tmp_path / "bare")
    (copy / "README.md").unlink()
    export_folder(copy, tmp_path / "again")
    assert "Not recorded" in (tmp_path / "again" / "README.md").read_text()


def test_a_new_judgement_takes_the_place_of_the_card_s_own(run, folder):
    share = Interval(0.5, 0.4, 0.6)
    tier = Tier("all", 30, share, share, 0.2, {"rod": 0.5}, {"rod": 30})
    before, old, new = (
        (folder / "README.md").read_text(),
        *(Judgement(name, "adapt", (tier,)) for name in ("old.npz", "new.npz")),
    )
    once = carried(before, old)
    assert "On real objects of `old.npz`, part adapt:" in once
    assert once.replace("old.npz", "new.npz") == carried(once, new) == carried(before, new)
    assert carried(once, None) == once
    said = ("## Training", "## Accuracy", "test clouds of kinectsim10", "## Limits", "Written by")
    assert all(once.count(words) == 1 for words in said)


def test_the_command_on_the_card_has_no_folders_of_its_machine(run, tmp_path, monkeypatch):
    words = ["experiment=x", "paths.data_dir=/home/me", "data.target.path=/home/me/my scans"]
    (tmp_path / "run" / ".hydra").mkdir(parents=True)
    (tmp_path / "run" / "result.pt").write_bytes((run / "result.pt").read_bytes())
    (tmp_path / "run" / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(words))
    export_folder(tmp_path / "run", tmp_path / "model")
    text = (tmp_path / "model" / "README.md").read_text()
    assert "qs3-train experiment=x 'data.target.path=my scans'" in text
    assert "/home" not in text


def test_names_of_classes_mean_nothing_on_the_card(run):
    result = replace(read_result(run), classes=("a", "<img src=x>", "[b](http://c)"))
    body = card(result, None)
    assert "<img" not in body
    assert "](" not in body


def test_what_is_there_stays(run, tmp_path, capsys):
    (tmp_path / "README.md").write_text("mine")
    assert main(["export", f"ckpt={run}", f"out={tmp_path}"]) == 1
    assert "a README.md of something else is there; refused" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]
    assert main(["export", f"ckpt={run}", f"out={tmp_path / 'model'}"]) == 0
    assert "MB), config.json and README.md" in capsys.readouterr().out
    assert main(["export", f"ckpt={tmp_path / 'model'}", f"out={tmp_path / 'model'}"]) == 1
    assert "is where it comes from" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("right", "of", "low", "high"),
    [
        # Newcombe, "Two-sided confidence intervals for the single proportion", Stat. Med. 17, 1998,
        # table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilsons_intervals_are_the_published_ones(right, of, low, high):
    assert wilson(right, of) == pytest.approx((low, high), abs=5e-5)
