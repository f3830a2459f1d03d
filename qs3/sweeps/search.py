"""A search over hyper-parameters that never looks at a label of the target: Optuna's TPE.

    ask Optuna for settings -> launch runs -> read the objective that each returns -> tell Optuna

The objective is `qs3.evaluation.validators.infomax`. What says how runs are judged may not vary
(`check_varied`). The study lies in a file next to the runs, so that the same
command goes on with it. A trial that failed or was interrupted stays open: it is run again, first
of all. One that diverged is a poor trial, and finished. What Optuna draws for a trial follows from
(seed, number of the trial): an interrupted search proposes what an uninterrupted one would have.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    IntervalSweep,
    Override,
    QuotedString,
    RangeSweep,
)
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig, open_dict

from qs3.config.compose import quoted
from qs3.config.hydra import config_sha256, run_name
from qs3.config.location import typed
from qs3.errors import ConfigError
from qs3.runs.metrics import read_metrics
from qs3.sweeps.plugins import ListedJobs, OverLauncher, RayLauncher
from qs3.training.provenance import refuse_changed
from qs3.training.run import run_of
from qs3.utils.files import locked
from qs3.utils.text_table import aligned

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial, Trial

VARIED = ("method", "model", "protocol", "selftraining")
"""First words of the keys that may differ between runs of which an objective chooses one."""


class LabelFreeSearch(OverLauncher):
    """Hydra's sweeper for `hparams_search=qbst_optuna`.

    Args:
        params: by key what to search, in Hydra's grammar for sweeps: `interval(0.5, 0.9)`,
            `range(1, 11)`, `choice(a, b)`, `tag(log, interval(1e-4, 1e-2))`; or a value.
        trials: of the whole study, also over several calls.
        at_once: trials that are asked for, and launched, together.
        seed: of the proposals.
        random: trials at random before TPE begins.
        folder: for the file of the study.
    """

    def __init__(
        self, params: dict[str, Any], trials: int, at_once: int, seed: int, random: int, folder: str
    ) -> None:
        super().__init__()
        self.params, self.folder = params, Path(folder)
        self.trials, self.at_once, self.seed, self.random = trials, at_once, seed, random

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Search until there are as many trials as were asked for; print the report."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        assert self.hydra_context is not None
        parser = OverridesParser.create(self.hydra_context.config_loader)
        fixed, searched = split(arguments, self.params, parser)
        cfg = self._composed(fixed)
        if cfg.objective is None:
            raise ConfigError("a search needs an objective, such as objective=infomax")
        space = {key: distribution(one) for key, one in searched.items()}
        study = self._study(cfg, space)
        lock = self.file.with_name(f".{self.file.stem}.lock")
        with locked(lock, f"another process is searching in {self.file}"):
            self._refuse_changed(study, fixed)
            done = self._until_enough(study, fixed, space)
        headline = f"Search by {cfg.objective}, which needs no labels; the study is {self.file}"
        tried = [_tried(trial) for trial in _trials(study)]
        sys.stdout.write(report(headline, cfg.objective, tried, fixed) + "\n")
        for result in done:
            _ = result.return_value  # raises if the job failed
        return done

    def _until_enough(
        self, study: Study, fixed: Sequence[str], space: Mapping[str, BaseDistribution]
    ) -> list[JobReturn]:
        """Launch open trials, then new ones, and tell the study, until it has as many as asked."""
        from optuna.trial import Trial, TrialState

        # The lock says that no process runs an open trial now.
        again: list[Trial] = []
        for trial in study.get_trials(states=(TrialState.RUNNING,)):
            if trial.params.keys() == space.keys():
                again.append(Trial(study, trial._trial_id))
            else:  # killed while it was asked for
                study.tell(trial.number, state=TrialState.FAIL)
        done: list[JobReturn] = []
        while True:
            batch, again = again[: self.at_once], again[self.at_once :]
            while len(batch) < self.at_once and len(_trials(study)) < self.trials:
                batch.append(self._ask(study, space))
            if not batch:
                return done
            jobs = [[*fixed, *_overrides(words(one.params))] for one in batch]
            results = self.launch(jobs, batch[0].number)
            for one, result in zip(batch, results, strict=True):
                _tell(study, one, result)
            done += results
            failed = all(result.status != JobStatus.COMPLETED for result in results)
            if failed and not study.get_trials(states=(TrialState.COMPLETE,)):
                return done  # e.g. no data: the next would end like these

    def _refuse_changed(self, study: Study, fixed: Sequence[str]) -> None:
        """Raise if one of the study's runs, which stands for all, was trained on other data."""
        from optuna.trial import TrialState

        for trial in study.get_trials(states=(TrialState.COMPLETE,)):
            cfg = self._composed([*fixed, *_overrides(words(trial.params))])
            run = run_of(cfg)
            if (metrics := read_metrics(run.folder)) is not None:
                refuse_changed(run, metrics)
                return

    def _composed(self, overrides: Sequence[str]) -> DictConfig:
        assert self.hydra_context is not None
        assert self.config is not None
        cfg = self.hydra_context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(cfg):
            del cfg["hydra"]
        return cfg

    def _study(self, cfg: DictConfig, space: Mapping[str, BaseDistribution]) -> Study:
        from optuna import create_study
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        which = [config_sha256(cfg), cfg.seed, cfg.objective, self.seed, self.random]
        text = json.dumps([*which, {key: str(one) for key, one in sorted(space.items())}])
        name = f"{cfg.experiment_name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
        self.file = self.folder / f"{name}.journal"
        self.folder.mkdir(parents=True, exist_ok=True)
        return create_study(
            storage=JournalStorage(JournalFileBackend(str(self.file))),
            study_name=name,
            direction="maximize",
            load_if_exists=True,
        )

    def _ask(self, study: Study, space: Mapping[str, BaseDistribution]) -> Trial:
        from optuna.samplers import TPESampler

        # Open trials count as poor ones, so that those of a batch differ.
        study.sampler = TPESampler(
            seed=self.seed + 1000 * len(_trials(study)),
            n_startup_trials=self.random,
            constant_liar=True,
        )
        return study.ask(dict(space))


def split(
    arguments: Sequence[str], params: Mapping[str, Any], parser: OverridesParser | None = None
) -> tuple[list[str], dict[str, Override]]:
    """Overrides that all runs share, and what is varied, by key.

    `params`: by key a value, or what to vary in Hydra's grammar for sweeps; `arguments` of the
    command line replace those of the same key.
    """
    parser = parser or OverridesParser.create()
    by_key = {one.get_key_element(): one for one in parser.parse_overrides(list(arguments))}
    for one in parser.parse_overrides([f"{key}={value}" for key, value in params.items()]):
        by_key.setdefault(one.get_key_element(), one)
    varied = {key: one for key, one in by_key.items() if one.is_sweep_override()}
    return [str(one.input_line) for key, one in by_key.items() if key not in varied], varied


def check_varied(varied: Iterable[Override]) -> None:
    """Refuse to vary what says how runs are judged, on which data, or what changes no result.

    Raises:
        ConfigError: a key is not below `VARIED`, or a group is put at a place that is not.
    """
    for one in varied:
        places = [one.key_or_group, *([one.package] if one.package else [])]
        if any(place.replace("/", ".").split(".")[0] not in VARIED for place in places):
            raise ConfigError(
                f"{one.input_line}: only {', '.join(VARIED)} may vary with objective="
            )


def distribution(one: Override) -> BaseDistribution:
    """A sweep of Hydra's as a distribution of Optuna's: whole numbers if both ends are."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    sweep: Any = one.value()
    more: dict[str, Any] = {}
    if isinstance(sweep, ChoiceSweep):
        plain: Any = [each.text if isinstance(each, QuotedString) else each for each in sweep.list]
        return CategoricalDistribution(plain)
    if isinstance(sweep, IntervalSweep):
        low, high, more["log"] = sweep.start, sweep.end, "log" in sweep.tags
    elif isinstance(sweep, RangeSweep):
        values = list(sweep.range())  # without its end
        low, high, more["step"] = values[0], round(values[-1], 10), sweep.step
    else:
        raise ConfigError(f"cannot search {one.input_line}; write interval, range or choice")
    whole = isinstance(low, int) and isinstance(high, int)
    return (IntDistribution if whole else FloatDistribution)(low, high, **more)  # type: ignore[arg-type]


def words(params: Mapping[str, Any]) -> dict[str, str]:
    """A trial's values in Hydra's grammar: numbers with six digits, text quoted if need be."""

    def word(value: Any) -> str:
        if isinstance(value, str):
            return quoted(value)
        return f"{value:.6g}" if isinstance(value, float) else json.dumps(value)

    return {key: word(value) for key, value in params.items()}


def _overrides(words: Mapping[str, str]) -> list[str]:
    return [f"{key}={word}" for key, word in words.items()]


class Tried(NamedTuple):
    """A trial: its number, by key what was varied in Hydra's grammar, objective and run.

    The objective is None if it failed, and NaN if it diverged.
    """

    number: int
    params: Mapping[str, str]
    value: float | None
    run: str


def report(headline: str, objective: str, tried: Sequence[Tried], fixed: Sequence[str]) -> str:
    """A table of all trials, in order, without any accuracy; `fixed`: overrides that all share."""
    keys = list(dict.fromkeys(key for one in tried for key in one.params))
    rows, judged = [("trial", objective, *keys, "run")], []
    for one in tried:
        value, run = "-", "failed" if one.value is None else f"diverged: {one.run}"
        if one.value is not None and math.isfinite(one.value):
            value, run = f"{one.value:.4f}", one.run
            judged.append((one.value, one))
        values = (one.params.get(key, "-") for key in keys)
        rows.append((str(one.number), value, *values, run))
    lines = [headline, *aligned(rows)]
    if judged:
        _, best = max(judged, key=lambda pair: pair[0])  # the first one wins a tie
        search = ("hparams_search=", "objective=", "seed=")
        kept = [word for word in fixed if not word.startswith(search)]
        command = shlex.join([*kept, *_overrides(best.params), "seed=0,1,2"])
        lines.append(f"Best: trial {best.number}. With several seeds:")
        lines.append(typed(f"  python train.py -m {command}"))
    return "\n".join(lines)


def _tell(study: Study, trial: Trial, result: JobReturn) -> None:
    """Close a trial whose run is finished. To TPE a pruned one, which diverged, is a poor one."""
    from optuna.trial import TrialState

    if result.status != JobStatus.COMPLETED:
        return
    value, cfg = result.return_value, result.cfg
    assert isinstance(value, float)
    assert cfg is not None
    trial.set_user_attr("run", run_name(cfg))
    if math.isfinite(value):
        study.tell(trial, value)
    else:
        study.tell(trial, state=TrialState.PRUNED)


def _tried(trial: FrozenTrial) -> Tried:
    run = trial.user_attrs.get("run", "")
    value = math.nan if run and trial.value is None else trial.value
    return Tried(trial.number, words(trial.params), value, run)


def _trials(study: Study) -> list[FrozenTrial]:
    """All but those that were killed while they were asked for."""
    return [trial for trial in study.get_trials() if trial.state.name != "FAIL"]


def register() -> None:
    """Put our sweepers and launcher into Hydra's list of plugins, before it looks for one.

    Their names must begin with `hydra_plugins`. Hydra's own way, a namespace package of that name,
    would be a second top-level package next to qs3.
    """
    known: dict[str, Any] = Plugins.instance().class_name_to_class
    for plugin in (ListedJobs, LabelFreeSearch, RayLauncher):
        known[f"hydra_plugins.qs3.{plugin.__name__}"] = plugin
