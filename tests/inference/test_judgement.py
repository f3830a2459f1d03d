"""What a run was found to be worth on real objects: on its card, and said by `qs3 predict`."""

import json
from dataclasses import replace

import numpy as np
import pytest

import qs3
from qs3.errors import ConfigError, DataError
from qs3.inference.export import export_command, export_folder
from qs3.inference.judgement import read_judgement
from qs3.inference.model_file import read_result, write_result
from tests.fixtures.frame_files import write_archive
from tests.running import main


@pytest.fixture(scope="module")
def known(run, tmp_path_factory):
    """The run's net in a file that calls its classes as an archive does."""
    path = tmp_path_factory.mktemp("known") / "result.pt"
    write_result(path, replace(read_result(run), classes=("bed", "chair", "sofa")))
    return path


@pytest.fixture(scope="module")
def judged(known, tmp_path_factory):
    """What `qs3 report judge` found of the run, and the archive."""
    folder = tmp_path_factory.mktemp("judged")
    write_archive(folder / "real.npz", {"train": 2, "test": 5}, points=150)
    words = [f"data={folder / 'real.npz'}", f"out={folder / 'judged.json'}"]
    assert main(["report", "judge", f"runs={known}", *words]) == 0
    return folder / "judged.json"


def test_the_card_and_predict_say_it(known, judged, tmp_path, capsys):
    figures = json.loads(judged.read_text())["families"][0]["figures"]
    every, mean = figures[0], figures[0]["accuracy"]["mean"]
    folder = tmp_path / "model"
    words = [f"ckpt={known}", f"out={folder}", f"judged={judged}"]
    assert main(["export", *words]) == 0
    card = (folder / "README.md").read_text()
    assert "On real objects of `real.npz`, part judge:" in card
    assert f"| all | {every['n']} | {100 * mean:.1f} % [" in card
    recalls = [f"{name} {100 * of:.1f} (of 5)" for name, of in every["recall"].items()]
    assert f"Recall %: {', '.join(recalls)}." in card
    worth = read_result(folder).worth
    assert worth.startswith(f"right about {100 * mean:.1f} % [")
    assert f"of {every['n']} real objects (real.npz, part judge), clean ones " in worth
    assert worth.endswith("always the commonest class 33.3 %")
    assert read_result(known).worth == ""
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(90, 3)))
    capsys.readouterr()
    out = tmp_path / "said.csv"
    assert main(["predict", f"ckpt={folder}", f"input={tmp_path / 'a.npy'}", f"out={out}"]) == 0
    assert f"what it is worth: {worth}\n" in capsys.readouterr().out
    assert f"What the net is worth: {worth}<" in out.with_suffix(".html").read_text()


def test_half_is_half_the_size_and_says_nearly_the_same(run, tmp_path):
    whole, half = tmp_path / "whole", tmp_path / "half"
    export_folder(run, whole)
    export_folder(run, half, half=True)
    sizes = [(folder / "model.safetensors").stat().st_size for folder in (whole, half)]
    assert 0.5 < sizes[1] / sizes[0] < 0.6
    clouds = np.random.default_rng(0).normal(size=(9, 90, 3))
    one, other = (qs3.load(folder)(clouds) for folder in (whole, half))
    assert 0 < np.abs(one - other).max() < 5e-3
    weights = read_result(half).weights
    assert {str(value.dtype) for value in weights.values() if value.ndim > 1} == {"torch.float16"}
    assert {str(value.dtype) for value in weights.values() if value.ndim == 1} == {"torch.float32"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda found: found.update(families=[]), "does not tell of"),
        (lambda found: found["families"][0].update(runs=["other/result.pt"]), "does not tell of"),
        (lambda found: found["families"][0]["runs"].append("b.pt"), "2 seeds together; judge "),
        (lambda found: found["families"][0].update(figures=[]), "families.0.figures"),
        (lambda found: found.pop("part"), "part: Field required"),
        (lambda found: found["families"][0]["figures"][0]["accuracy"].update(mean=2), "mean"),
        (lambda found: found["families"][0]["figures"][0].update(n="many"), "n: Input"),
    ],
)
def test_what_does_not_tell_of_this_run_is_refused(known, judged, tmp_path, change, message):
    found = json.loads(judged.read_text())
    change(found)
    (tmp_path / "j.json").write_text(json.dumps(found))
    with pytest.raises((ConfigError, DataError), match=message):
        read_judgement(tmp_path / "j.json", known)


def test_damage_and_mistakes_are_told(known, judged, tmp_path):
    path = tmp_path / "j.json"
    with pytest.raises(DataError, match=r"j\.json cannot be read"):
        read_judgement(path, known)
    for data in (b"", b"[1]", b"{", b"[" * 100_000, judged.read_bytes()[:-9]):
        path.write_bytes(data)
        with pytest.raises(DataError, match="is damaged, or not of `qs3 report judge`"):
            read_judgement(path, known)
    with pytest.raises(ConfigError, match=r"give the \.json of"):
        read_judgement(tmp_path / "j.csv", known)
    for words in ({"judged": judged}, {"half": True}):
        with pytest.raises(ConfigError, match="judged= and half= are for a folder"):
            export_command(known, tmp_path / "a.onnx", **words)
