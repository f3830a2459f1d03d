"""Every scheme of self-training and every method, stopped in the middle of an epoch and continued.

`test_resume` stops one run in every possible place; here every kind of run is stopped in one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from qs3.config.hydra import run_folder
from qs3.runs.checkpoints import load
from qs3.training.command import train
from tests.training.conftest import result_of
from tests.training.toy import CONF
from tests.training.watching import interrupt

# 7 epochs: 0-2 warm-up, 3-4 round 0, 5-6 round 1
FIRST, LAST = 3, 6
FEATURED = "model._target_=tests.training.nets.featured"
NODES = "model._target_=tests.training.nets.with_nodes"
FREE = "selftraining.theta=0"  # CBST has thresholds of its own
OWN = Path(__file__).parent / "own_method.py"
SCHEMES = {
    "qbst": ("selftraining=qbst",),
    "spst": ("selftraining=spst", "selftraining.weight_step=0.1"),
    "cbst": ("selftraining=cbst", FREE),
    "lrent": ("selftraining=cbst", "selftraining.selector.labels=lrent", FREE),
    "crst_mrkld": ("selftraining=crst_mrkld", FREE),
    "random": ("selftraining=random",),
    "sd": ("selftraining=sd", FREE, "selftraining.selector.steps=3", FEATURED),
    "released": ("selftraining=qbst_released",),
    "beside": ("selftraining=qbst_beside",),
    "steps": ("selftraining=qbst", "protocol.steps=8", "selftraining.steps=5"),
    "continued_alone": ("selftraining=qbst", "selftraining.init=continue", "selftraining.pcm=true"),
    "double": ("trainer.precision=64-true",),
}
METHODS = {
    "source_only": ("method=source_only",),
    "dann": ("method=dann", FEATURED),
    "defrec_pcm": ("method=defrec_pcm", "method.min_points=2", FEATURED),
    "gast": ("method=gast", "method.min_points=2", FEATURED),
    "pointdan": ("method=pointdan", NODES),
    "sd": ("method=sd", FEATURED),
    "cpcm": ("method=cpcm",),
    "mlsp": ("method=mlsp", FEATURED),
    "pcfea": ("method=pcfea", "method.every=1.0", FEATURED),  # its only pool is of epoch 1
    "supervised": ("method=supervised",),
    "own": ("method=own", f"method.file={OWN}"),
}


def check(toy: Any, finished: Path, settings: tuple[str, ...], *epochs: int) -> None:
    """Stopped after the first batch of each of `epochs`, a run ends as if it had not been."""
    whole = toy(*settings, f"paths.log_dir={finished.parents[1]}", "paths.warmup_dir=null")
    broken = toy(*settings)
    train(whole)  # unless it is `finished`
    for epoch in epochs:
        interrupt(broken, epoch=epoch)
        assert load(run_folder(broken) / "last.ckpt")["epoch"] == epoch - 1
    train(broken)
    ours, theirs = run_folder(broken), run_folder(whole)
    assert result_of(ours) == result_of(theirs)
    files = [file for file in theirs.glob("*.pt") if file.name != "result.pt"]
    assert len(files) >= 3
    for file in files:
        weights = load(file)
        assert all(torch.equal(load(ours / file.name)[key], x) for key, x in weights.items())
    state = load(theirs / "last.ckpt")["state_dict"]  # the method's heads, too
    ours_state = load(ours / "last.ckpt")["state_dict"]
    assert all(torch.equal(ours_state[key], value) for key, value in state.items())


def fast_are(fast: set[str], names: dict[str, Any]) -> list[Any]:
    return [pytest.param(n, marks=[] if n in fast else pytest.mark.slow) for n in names]


@pytest.mark.parametrize("name", fast_are({"qbst", "pseudo_val", "double"}, SCHEMES))
def test_every_scheme_goes_on_in_the_middle_of_a_round(toy, finished, name):
    check(toy, finished, SCHEMES[name], FIRST, LAST)


@pytest.mark.slow
def test_a_plateau_goes_on(toy, tmp_path, finished):
    """In its warm-up; each round begins anew."""
    words = ("protocol=simpleview", "protocol.epochs=40", "protocol.optimizer.lr=4.0")
    check(toy, finished, words, 20)
    (file,) = tmp_path.glob("logs/quickstart/*/history.csv")
    rows = file.read_text().splitlines()
    rates = [float(row.split(",")[2]) for row in rows[1:]]
    assert rates[0] == 4.0 > rates[39]
    assert rates[40:] == [4.0] * 4


def test_a_given_teacher_goes_on(toy, finished):
    words = ("selection.teacher=given", "protocol.epochs=1", "selftraining.init=continue")
    check(toy, finished, (*words, f"weights={finished}"), 1, 3)


@pytest.mark.parametrize("name", fast_are({"gast"}, METHODS))
def test_every_method_goes_on_in_the_middle_of_the_warmup(toy, finished, name):
    epochs = (1, 2) if name == "pcfea" else (1,)
    words = (f"protocol.epochs={epochs[-1] + 1}", "selftraining=none")
    check(toy, finished, (*words, *METHODS[name]), *epochs)


def test_every_config_of_both_groups_is_tried():
    groups = {"selftraining": {"none"}, "method": set()}
    for settings in (*SCHEMES.values(), *METHODS.values()):
        for setting in settings:
            group, _, choice = setting.partition("=")
            if group in groups:
                groups[group].add(choice)
    groups["method"] |= {"pcm", "defrec"}  # of all schemes; of defrec_pcm
    for group, tried in groups.items():
        assert {path.stem for path in (CONF / group).glob("*.yaml")} == tried
