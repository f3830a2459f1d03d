"""Searches over hyper-parameters that never look at a label of the target: TPE, and a grid.

    ask Optuna for settings -> launch runs -> read the objective that each returns -> tell Optuna

The objective is a validator of `qs3.evaluation.validators`: accuracy is refused. The study lies
in a file beside the runs, so that the same command goes on with it: trials that have finished are
not repeated, those that failed or were interrupted are tried again. One that diverged is a bad
trial, not a failed one. What Optuna draws for a trial follows from (seed, number of the trial): an
interrupted search proposes what an uninterrupted one would have.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import sys
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig

from qs3.config import hashing
from qs3.config.checks import check_int
from qs3.errors import ConfigError
from qs3.evaluation.selection_rules import check_objective
from qs3.sweeps.launching import OverLauncher
from qs3.sweeps.search_report import FAILED, Tried, report
from qs3.sweeps.search_space import distribution, overrides, split, words

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial, Trial

_AGAIN = "again"  # of a trial: the number of the one that it repeats


class Judged(OverLauncher):
    """What both searches have in common: what they may vary, and what they may look at.

    Args:
        params: by key what to search, in Hydra's grammar for sweeps, or a value.
    """

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.params = dict(params)

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Search; print all trials, the best, and the command that repeats it with more seeds."""
        loader = self.hydra_context.config_loader
        fixed, searched = split(arguments, self.params, loader)
        cfg = loader.load_sweep_config(self.config, list(fixed))
        check_objective(cfg.objective, cfg.selection.student)
        if cfg.objective is None:
            raise ConfigError("a search needs an objective; set objective=infomax, say")
        done = self.search(cfg, fixed, searched)
        for result in done:
            _ = result.return_value  # raises if the job failed
        return done

    @abstractmethod
    def search(
        self, cfg: DictConfig, fixed: list[str], searched: Mapping[str, Override]
    ) -> list[JobReturn]:
        """Launch runs and print the report.

        Args:
            cfg: what all trials share.
            fixed: the overrides that made it.
            searched: the others, by key.
        """

    def say(
        self, kind: str, more: str, cfg: DictConfig, tried: Sequence[Tried], fixed: Sequence[str]
    ) -> None:
        """Print the report."""
        headline = f"{kind} by {cfg.objective}, which needs no labels{more}"
        text = report(headline, cfg.objective, _lower_is_better(cfg), tried, fixed)
        sys.stdout.write(text + "\n")


class LabelFreeGrid(Judged):
    """Hydra's sweeper for `hparams_search=qbst_grid`: every combination.

    Args:
        params: by key the values: `0.6,0.7,0.8`, `range(5, 16, 5)` or `choice(a, b)`.
        at_once: so many are handed to the launcher, and waited for, before the next; None: all.
    """

    def __init__(self, params: Mapping[str, Any], at_once: int | None = None) -> None:
        super().__init__(params)
        self.at_once = None if at_once is None else check_int("hydra.sweeper.at_once", at_once, 1)

    def search(
        self, cfg: DictConfig, fixed: list[str], searched: Mapping[str, Override]
    ) -> list[JobReturn]:
        """Of what the command line leaves open, in the order of the keys."""
        values = {}
        for key, one in searched.items():
            if not one.is_discrete_sweep():
                raise ConfigError(
                    f"{one.input_line}: a grid needs the values themselves; write {key}=a,b,c, or "
                    "search with hparams_search=qbst_optuna"
                )
            values[key] = list(one.sweep_string_iterator())
            if not values[key]:
                raise ConfigError(f"{one.input_line} has no values; write {key}=a,b,c")
        cells = [
            dict(zip(values, cell, strict=True)) for cell in itertools.product(*values.values())
        ]
        jobs = [[*fixed, *overrides(cell)] for cell in cells]
        step, done = self.at_once or len(jobs), []
        for first in range(0, len(jobs), step):
            done += self.launch(jobs[first : first + step], first)
        tried = [Tried.of(i, cells[i], result) for i, result in enumerate(done)]
        self.say("Grid", "", cfg, tried, fixed)
        return done


class LabelFreeSearch(Judged):
    """Hydra's sweeper for `hparams_search=qbst_optuna`.

    Args:
        params: by key what to search: `interval(0.5, 0.9)`, `range(1, 11)`, `choice(a, b)`, and
            `tag(log, interval(1e-4, 1e-2))`.
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
        super().__init__(params)
        self.trials = check_int("hydra.sweeper.trials", trials, 1)
        self.at_once = check_int("hydra.sweeper.at_once", at_once, 1)
        self.seed = check_int("hydra.sweeper.seed", seed, 0)
        self.random = check_int("hydra.sweeper.random", random, 1)
        self.folder = Path(folder)

    def search(
        self, cfg: DictConfig, fixed: list[str], searched: Mapping[str, Override]
    ) -> list[JobReturn]:
        """Until there are as many trials as were asked for."""
        try:
            import optuna
        except ImportError as error:
            raise ConfigError("the search needs Optuna: pip install 'qs3[search]'") from error
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        space = {key: distribution(one) for key, one in searched.items()}
        study = self._study(cfg, space)
        _try_again(study)
        done: list[JobReturn] = []
        while (left := self.trials - _count(study)) > 0 or _waiting(study):
            batch = [self._ask(study, space) for _ in range(min(self.at_once, max(left, 1)))]
            jobs = [[*fixed, *overrides(words(trial.params))] for trial in batch]
            results = self.launch(jobs, batch[0].number)
            for trial, result in zip(batch, results, strict=True):
                _tell(study, trial, result)
            done += results
            if not _finished(study) and all(r.status != JobStatus.COMPLETED for r in results):
                break  # e.g. no data: the next would end like these
        self.say("Search", f"; the study is {self.file}", cfg, _tried(study), fixed)
        return done

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
            direction="minimize" if _lower_is_better(cfg) else "maximize",
            load_if_exists=True,
        )

    def _ask(self, study: Study, space: Mapping[str, BaseDistribution]) -> Trial:
        from optuna.samplers import TPESampler

        # Trials that are still running count as bad ones, so that those of a batch differ.
        study.sampler = TPESampler(
            seed=self.seed + 1000 * _count(study), n_startup_trials=self.random, constant_liar=True
        )
        return study.ask(dict(space))


def _lower_is_better(cfg: DictConfig) -> bool:
    from qs3.evaluation.validators import LABEL_FREE

    return not LABEL_FREE[cfg.objective].higher_is_better


def _tell(study: Study, trial: Trial, result: JobReturn) -> None:
    from optuna.trial import TrialState

    one = Tried.of(trial.number, words(trial.params), result)
    trial.set_user_attr("run", one.run)
    if one.value is not None:
        study.tell(trial, one.value)
    else:  # a pruned trial is a bad one to TPE, and is not tried again: it would diverge again
        again = one.run == FAILED
        study.tell(trial, state=TrialState.FAIL if again else TrialState.PRUNED)


def _tried(study: Study) -> list[Tried]:
    """The study's trials; of one that was repeated, the repetition."""
    return [
        Tried(trial.number, words(trial.params), trial.value, trial.user_attrs.get("run", FAILED))
        for trial in study.trials
        if trial.number not in _repeated(study)
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


def _waiting(study: Study) -> list[FrozenTrial]:
    from optuna.trial import TrialState

    return study.get_trials(deepcopy=False, states=(TrialState.WAITING,))


def _finished(study: Study) -> list[FrozenTrial]:
    from optuna.trial import TrialState

    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
