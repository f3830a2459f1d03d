"""What is left out, or null: an error that says what to do, or nothing of it."""

from __future__ import annotations

import pytest

from qs3.api import train as train_by_words
from qs3.config import hashing
from qs3.config.compose import composed
from qs3.errors import ConfigError, MissingDataError, Qs3Error
from qs3.runs.metrics import read_metrics
from qs3.training.command import train
from qs3.training.settings import check_settings
from tests.composing import compose


@pytest.mark.parametrize(
    ("word", "advice"),
    [
        ("~method", "give method=NAME, one of cpcm, "),
        ("~method._target_", "give method=NAME, one of cpcm, "),
        ("~protocol", "leave out the word with ~"),
        ("~selftraining", "for no rounds set selftraining=none"),
        ("~report", "for no pictures set report.pictures=false"),
        ("~report.pictures", "leave out the word with ~"),
        ("~evaluation", "give one, as evaluation.rotations=0"),
        ("~selection", "give one, as selection.student=last"),
        ("~protocol.epochs", "leave out the word with ~"),
        ("~protocol.augment", "for clouds as they are set protocol.augment.rotate_z=false"),
        ("~protocol.optimizer", "give one, as protocol.optimizer.lr=0.001"),
        ("~experiment_name", "leave out the word with ~"),
        ("~paths", "leave out the word with ~"),
        ("~data.scale", "leave out the word with ~"),
        ("~trainer.accelerator", "leave out the word with ~"),
    ],
)
def test_what_is_left_out_is_named(word, advice):
    with pytest.raises(ConfigError, match=rf"^{word[1:].split('.')[0]}.* not there") as said:
        check_settings(compose("train", ["experiment=quickstart", word]))
    assert advice in str(said.value)
    assert "\n" not in str(said.value)


@pytest.mark.parametrize(
    "key", ["evaluation", "selection", "report", "protocol.augment", "protocol.optimizer"]
)
def test_null_is_no_settings(key):
    with pytest.raises(ConfigError, match=f"^{key}=null: these are several settings; "):
        check_settings(compose("train", ["experiment=quickstart", f"{key}=null"]))


def test_weights_of_float16_are_refused():
    """Every net was NaN after a few steps of Adam, and the run ended as if nothing were wrong."""
    with pytest.raises(
        ConfigError, match=r"^trainer\.precision=16-true: .*set trainer\.precision=bf"
    ):
        check_settings(compose("train", ["experiment=quickstart", "trainer.precision=16-true"]))


@pytest.mark.parametrize(
    ("word", "known"),
    [
        ("logger=null", "csv, wandb"),
        ("+experiment=Null", "cad10, "),
        ("domain@data.source=null", "blensor10, "),
        ("model=3", "dgcnn, "),
        ("callbacks=false", "default, none"),
        ("trainer=-1.5", "cpu, "),
    ],
)
def test_a_choice_of_a_file_is_its_name(word, known):
    with pytest.raises(ConfigError) as said:
        composed("train", "seed=3", word)
    assert str(said.value).startswith(f"{word}: ")
    assert f"there are {known}" in str(said.value)


@pytest.mark.parametrize("word", ["~seed", "~experiment_name", "~paths.log_dir", "~method"])
def test_a_function_says_so_too(word):
    """Also where the run's folder cannot be named without it."""
    with pytest.raises(ConfigError, match=f"^{word[1:]} is not there"):
        train_by_words("experiment=quickstart", word)


def test_without_callbacks_and_loggers_there_are_none(toy):
    """The run is that of callbacks=none, and writes history.csv alone."""
    cfg = toy("selftraining=none", "~callbacks", "~logger")
    assert not {"callbacks", "logger"} & set(cfg)
    folder = hashing.run_folder(cfg)
    assert folder == hashing.run_folder(toy("selftraining=none"))
    assert train(cfg) == read_metrics(folder)
    assert (folder / "history.csv").is_file()


def test_copies_of_a_run_are_refused(toy, monkeypatch):
    """Each would take itself for one of several processes, and nobody would lead them."""
    with pytest.raises(ConfigError, match=r"^trainer\.num_nodes=2 cannot be had: a run is on one"):
        train(toy("trainer.num_nodes=2"))
    for key, value in {"TORCHELASTIC_RUN_ID": "none", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(key, value)
    with pytest.raises(ConfigError, match=r"^torchrun starts several .* trainer\.devices=N$"):
        train(toy())


@pytest.mark.parametrize("key", ["theta", "epsilon"])
def test_a_threshold_beside_a_share_is_refused(key):
    """It changed the run's name alone: a search over thresholds compared copies of one run."""
    said = rf"selftraining\.{key} would have no effect: selftraining\.share=0\.5 sets"
    with pytest.raises(ConfigError, match=said):
        train_by_words(
            "experiment=source_only_nyu", "selftraining=qbst", f"selftraining.{key}=0.01"
        )


def test_epochs_beside_a_budget_in_steps_are_warned_of(monkeypatch, tmp_path, caplog):
    monkeypatch.chdir(tmp_path)  # where there are no data, so that nothing is trained
    for words, warned in (
        (["protocol.epochs=20"], ["protocol.epochs=20 trains neither"]),
        (["protocol.epochs=20", "protocol.steps=500"], []),
        (["protocol.epochs=20", "protocol.steps=null", "selftraining.epochs=5"], ["selftraining"]),
        (["protocol.epochs=20", "selftraining=none", "debug=overfit"], []),
        ([], []),
    ):
        caplog.clear()
        with pytest.raises(MissingDataError):
            train_by_words("experiment=quickstart", *words)
        found = [one.message for one in caplog.records if "trains neither" in one.message]
        assert len(found) == len(warned)
        assert all(word in one for one, word in zip(found, warned, strict=True))


def test_a_net_without_features_is_refused_before_the_warm_up(toy):
    """By rounds that look at them, too."""
    cfg = toy("selftraining=sd", "selftraining.theta=0", "selftraining.rounds=1")
    with pytest.raises(ConfigError, match=r"selector \(GraphRefined\) needs .*TinyNet has none"):
        train(cfg)
    assert not (hashing.run_folder(cfg) / "history.csv").exists()


@pytest.mark.parametrize(
    ("words", "warned"),
    [
        ("experiment=own_scans", False),
        ("experiment=own_scans protocol.steps=100", True),
        ("experiment=own_scans protocol.steps=null", True),
        ("experiment=own_scans selection.teacher=last protocol.steps=9", False),
        ("experiment=own_scans selftraining=none protocol.steps=9", False),  # said after loading
    ],
)
def test_a_warm_up_for_nothing_is_warned_of(words, warned, monkeypatch, tmp_path, caplog):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Qs3Error):  # no scans are there
        train_by_words(*words.split(), "data.target.published.folder=scans")
    assert ("what the warm-up trains is used for nothing" in caplog.text) == warned
