"""A search over hyper-parameters that never looks at a label of the target: Optuna's TPE.

    ask Optuna for settings -> launch runs -> read the objective that each returns -> tell Optuna

The objective is a validator of `qs3.evaluation.validators`: accuracy is refused, and so is to vary
what says how runs are judged (`qs3.sweeps.summary` checks both). The study lies in a file next to
the runs, so that the same command goes on with it: trials that have finished are not repeated,
those that failed or were interrupted are tried again. One that diverged is a bad trial, not a
failed one. What Optuna draws for a trial follows from (seed, number of the trial): an interrupted
search proposes what an uninterrupted one would have.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig

from qs3.config import hashing
from qs3.config.checks import check_int
from qs3.errors import ConfigError
from qs3.evaluation.validators import LABEL_FREE
from qs3.sweeps.listed_jobs import ListedJobs, OverLauncher
from qs3.sweeps.ray_launcher import RayLauncher
from qs3.sweeps.search_report import FAILED, Tried, report
from qs3.sweeps.search_space import distribution, overrides, split, words
from qs3.training.reuse import check_finished
from qs3.utils.locks import alone

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial

_AGAIN = "again"  # of a trial: the number of the one that it repeats


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
        self, params: Mapping[str, Any], trials: int, at_once: int, seed: int, random: int,
        folder: str,
    ) -> None:  # fmt: skip
        self.params = dict(params)
        self.trials = check_int("hydra.sweeper.trials", trials, 1)
        self.at_once = check_int("hydra.sweeper.at_once", at_once, 1)
        self.seed = check_int("hydra.sweeper.seed", seed, 0)
        self.random = check_int("hydra.sweeper.random", random, 1)
        self.folder = Path(folder)

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Search until there are as many trials as were asked for; print the report."""
        try:
            import optuna
        except ImportError as error:
            raise ConfigError(
                "the search needs Optuna: pip install '.[search]' in the folder of qs3"
            ) from error
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        loader = self.hydra_context.config_loader
        fixed, searched = split(arguments, self.params, OverridesParser.create(loader))
        cfg = loader.load_sweep_config(self.config, list(fixed))
        if cfg.objective is None:
            raise ConfigError("a search needs an objective; set objective=infomax, say")
        if not searched:
            raise ConfigError(
                "there is nothing to search; set hydra.sweeper.params, or key='interval(low,high)'"
            )
        space = {key: distribution(one) for key, one in searched.items()}
        study = self._study(cfg, space)
        lock = self.file.with_name(f".{self.file.stem}.lock")
        with alone(lock, f"another process is searching in {self.file}; wait for it or stop it"):
            # What has no end there was interrupted, then, and is nobody's any more.
            self._refuse_changed(study, fixed)
            _try_again(study)
            done = self._until_enough(study, fixed, space)
        headline = f"Search by {cfg.objective}, which needs no labels; the study is {self.file}"
        sys.stdout.write(report(headline, cfg.objective, _tried(study), fixed) + "\n")
        for result in done:
            _ = result.return_value  # raises if the job failed
        return done

    def _until_enough(
        self, study: Study, fixed: Sequence[str], space: Mapping[str, BaseDistribution]
    ) -> list[JobReturn]:
        """Ask for trials, launch them and tell the study, until it has as many as it should."""
        done: list[JobReturn] = []
        while (left := self.trials - _count(study)) > 0 or _any(study, "WAITING"):
            batch = [self._ask(study, space) for _ in range(min(self.at_once, max(left, 1)))]
            jobs = [[*fixed, *overrides(words(trial.params))] for trial in batch]
            results = self.launch(jobs, batch[0].number)
            for trial, result in zip(batch, results, strict=True):
                _tell(study, trial, result)
            done += results
            failed = all(result.status != JobStatus.COMPLETED for result in results)
            if failed and not _any(study, "COMPLETE"):
                break  # e.g. no data: the next would end like these
        return done

    def _refuse_changed(self, study: Study, fixed: Sequence[str]) -> None:
        """Raise if the study's runs were trained on other data, or on another classifier.

        Objectives of two datasets say nothing about settings. One run stands for all: who went on
        with the study came by here.
        """
        from optuna.trial import TrialState

        loader = self.hydra_context.config_loader
        for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            one = loader.load_sweep_config(self.config, [*fixed, *overrides(words(trial.params))])
            if check_finished(one, "or begin another search with another experiment_name"):
                return

    def _study(self, cfg: DictConfig, space: Mapping[str, BaseDistribution]) -> Study:
        from optuna import create_study
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        which = [hashing.config_sha256(cfg), cfg.seed, cfg.objective, self.seed, self.random]
        text = json.dumps([*which, {key: str(one) for key, one in sorted(space.items())}])
        name = f"{cfg.experiment_name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
        self.file = self.folder / f"{name}.journal"
        self.folder.mkdir(parents=True, exist_ok=True)
        return create_study(
            storage=JournalStorage(JournalFileBackend(str(self.file))),
            study_name=name,
            direction="maximize" if LABEL_FREE[cfg.objective].higher_is_better else "minimize",
            load_if_exists=True,
        )

    def _ask(self, study: Study, space: Mapping[str, BaseDistribution]) -> Trial:
        from optuna.samplers import TPESampler

        # Trials that are still running count as bad ones, so that those of a batch differ.
        study.sampler = TPESampler(
            seed=self.seed + 1000 * _count(study), n_startup_trials=self.random, constant_liar=True
        )
        return study.ask(dict(space))


def _tell(study: Study, trial: Trial, result: JobReturn) -> None:
    from optuna.trial import TrialState

    value, run = None, ""
    if result.status == JobStatus.COMPLETED:
        value, run = float(result.return_value), hashing.run_name(result.cfg)  # type: ignore[arg-type]
    one = Tried.of(trial.number, words(trial.params), value, run)
    trial.set_user_attr("run", one.run)
    if one.value is not None:
        study.tell(trial, one.value)
    else:  # a pruned trial is a bad one to TPE, and is not tried again: it would diverge again
        study.tell(trial, state=TrialState.FAIL if value is None else TrialState.PRUNED)


def _tried(study: Study) -> list[Tried]:
    """The study's trials; of one that was repeated, the repetition."""
    repeated = _repeated(study)
    return [
        Tried(trial.number, words(trial.params), trial.value, trial.user_attrs.get("run", FAILED))
        for trial in study.trials
        if trial.number not in repeated
    ]


def _try_again(study: Study) -> None:
    """Put trials that failed, or that an interruption left without an end, in the queue again."""
    from optuna.trial import TrialState

    repeated = _repeated(study)
    for trial in study.trials:
        if trial.state == TrialState.RUNNING:
            study.tell(trial.number, state=TrialState.FAIL)
        if trial.state in (TrialState.RUNNING, TrialState.FAIL) and trial.number not in repeated:
            study.enqueue_trial(trial.params, user_attrs={_AGAIN: trial.number})


def _repeated(study: Study) -> set[int]:
    return {trial.user_attrs[_AGAIN] for trial in study.trials if _AGAIN in trial.user_attrs}


def _count(study: Study) -> int:
    """Trials so far; one that was repeated is one."""
    return sum(_AGAIN not in trial.user_attrs for trial in study.trials)


def _any(study: Study, state: str) -> bool:
    return any(trial.state.name == state for trial in study.trials)


def register() -> None:
    """Put our sweepers and launcher into Hydra's list of plugins, before it looks for one.

    Their names must begin with `hydra_plugins`. Hydra's own way, a namespace package of that name,
    would be a second top-level package next to qs3.
    """
    known: dict[str, Any] = Plugins.instance().class_name_to_class
    for plugin in (ListedJobs, LabelFreeSearch, RayLauncher):
        known[f"hydra_plugins.qs3.{plugin.__name__}"] = plugin
