"""A search over hyper-parameters that never looks at a label of the target (Optuna's TPE).

    ask Optuna for settings -> launch runs -> read the objective that each returns -> tell Optuna

The objective is a validator of `qs3.selftraining.validators`: accuracy is refused. The study lies
in a file beside the runs, so that the same command goes on with it: trials that have finished are
not repeated, those that failed or were interrupted are tried again. What Optuna draws for a trial
follows from (seed, number of the trial): an interrupted search proposes what an uninterrupted one
would have.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    IntervalSweep,
    Override,
    QuotedString,
    RangeSweep,
)
from hydra.core.utils import JobReturn, JobStatus

from qs3 import runs
from qs3.errors import ConfigError
from qs3.selftraining.student_rules import check_objective
from qs3.settings import whole
from qs3.sweepers import OverLauncher

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial, Trial

log = logging.getLogger(__name__)

_AGAIN = "again"  # of a trial: the number of the one that it repeats


class LabelFreeSearch(OverLauncher):
    """Hydra's sweeper for `hparams_search=qbst_optuna`.

    Args:
        params: by key what to search, in Hydra's grammar for sweeps: `interval(0.5, 0.9)`,
            `range(1, 11)`, `choice(a, b)`, and `tag(log, interval(1e-4, 1e-2))`.
        trials: of the whole study, also over several calls.
        at_once: trials that are asked for, and launched, together.
        seed: of the proposals.
        random: trials at random before TPE begins.
        folder: for the file of the study.
    """

    def __init__(
        self, params: Mapping[str, str], trials: int, at_once: int, seed: int, random: int,
        folder: str,
    ) -> None:  # fmt: skip
        self.params = dict(params)
        self.trials = whole("hydra.sweeper.trials", trials, 1)
        self.at_once = whole("hydra.sweeper.at_once", at_once, 1)
        self.seed = whole("hydra.sweeper.seed", seed, 0)
        self.random = whole("hydra.sweeper.random", random, 1)
        self.folder = Path(folder)

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Search; print all trials, the best, and the command that repeats it with more seeds."""
        fixed, space = self._split(arguments)
        check_objective(self.config.objective, self.config.selection.student)
        if self.config.objective is None:
            raise ConfigError("a search needs an objective; set objective=infomax, say")
        study = self._study(fixed, space)
        _try_again(study)
        done: list[JobReturn] = []
        while (left := self.trials - _count(study)) > 0 or _waiting(study):
            batch = [self._ask(study, space) for _ in range(min(self.at_once, max(left, 1)))]
            jobs = [[*fixed, *_overrides(trial.params)] for trial in batch]
            results = self.launch(jobs, batch[0].number)
            for trial, result in zip(batch, results, strict=True):
                _tell(study, trial, result)
            done += results
            if not _finished(study) and all(r.status != JobStatus.COMPLETED for r in results):
                break  # e.g. no data: the next would end like these
        sys.stdout.write(self._report(study, fixed) + "\n")
        for result in done:
            _ = result.return_value  # raises if the job failed
        return done

    def _split(self, arguments: Sequence[str]) -> tuple[list[str], dict[str, BaseDistribution]]:
        """Overrides that all trials share, and what is searched."""
        parse = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        by_key = {o.get_key_element(): o for o in parse.parse_overrides(list(arguments))}
        for one in parse.parse_overrides([f"{key}={value}" for key, value in self.params.items()]):
            by_key.setdefault(one.get_key_element(), one)  # what was typed counts
        space = {k: distribution(o) for k, o in by_key.items() if o.is_sweep_override()}
        if "seed" in space:
            raise ConfigError(
                "a search tries each setting with one seed, because seeds are nothing to choose "
                "by; give one seed, and repeat the best setting with several afterwards"
            )
        if not space:
            raise ConfigError(
                "there is nothing to search; set hydra.sweeper.params, or key='interval(low,high)'"
            )
        return [str(o.input_line) for o in by_key.values() if not o.is_sweep_override()], space

    def _study(self, fixed: list[str], space: Mapping[str, BaseDistribution]) -> Study:
        try:
            import optuna
            from optuna.storages import JournalStorage
            from optuna.storages.journal import JournalFileBackend
        except ImportError as error:
            raise ConfigError("the search needs Optuna: pip install 'qs3[search]'") from error
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        cfg = self.hydra_context.config_loader.load_sweep_config(self.config, list(fixed))
        which = [runs.config_sha256(cfg), cfg.seed, cfg.objective, self.seed, self.random]
        text = json.dumps([*which, {key: str(one) for key, one in sorted(space.items())}])
        name = f"{cfg.experiment_name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
        self.file = self.folder / f"{name}.journal"
        self.folder.mkdir(parents=True, exist_ok=True)
        from qs3.selftraining.validators import LABEL_FREE

        validator = LABEL_FREE.get(cfg.objective)
        lower = validator is not None and not validator.higher_is_better
        return optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(self.file))),
            study_name=name,
            direction="minimize" if lower else "maximize",
            load_if_exists=True,
        )

    def _ask(self, study: Study, space: Mapping[str, BaseDistribution]) -> Trial:
        from optuna.samplers import TPESampler

        # Trials that are still running count as bad ones, so that those of a batch differ.
        study.sampler = TPESampler(
            seed=self.seed + 1000 * _count(study), n_startup_trials=self.random, constant_liar=True
        )
        return study.ask(dict(space))

    def _report(self, study: Study, fixed: Sequence[str]) -> str:
        """All trials, the best one, and what to do with it."""
        from qs3.report.aggregate import align

        objective = self.config.objective
        shown = [trial for trial in study.trials if trial.number not in _repeated(study)]
        keys = list(dict.fromkeys(key for trial in shown for key in trial.params))
        rows = [("trial", objective, *keys, "run")]
        for trial in shown:
            value = "-" if trial.value is None else f"{trial.value:.4f}"
            values = (_text(trial.params.get(key, "-")) for key in keys)
            rows.append((str(trial.number), value, *values, trial.user_attrs.get("run", "failed")))
        words = [f"Search by {objective}, which needs no labels; the study is {self.file}"]
        words += align(rows)
        if _finished(study):
            best = study.best_trial
            search = ("hparams_search=", "objective=", "seed=")
            kept = [word for word in fixed if not word.startswith(search)]
            command = shlex.join([*kept, *_overrides(best.params), "seed=0,1,2"])
            words.append(f"Best: trial {best.number}. With several seeds:")
            words.append(f"  python train.py -m {command}")
        return "\n".join(words)


def distribution(override: Override) -> BaseDistribution:
    """What Optuna calls a sweep of Hydra's.

    Raises:
        ConfigError: the sweep is of another kind.
    """
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    sweep: Any = override.value()
    key, log_scale = override.get_key_element(), "log" in getattr(sweep, "tags", ())
    if isinstance(sweep, ChoiceSweep):
        plain: list[Any] = [
            one.text if isinstance(one, QuotedString) else one for one in sweep.list
        ]
        return CategoricalDistribution(plain)
    if isinstance(sweep, IntervalSweep):
        low, high = sweep.start, sweep.end
        assert low is not None
        assert high is not None
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, log=log_scale)
        return FloatDistribution(float(low), float(high), log=log_scale)
    if isinstance(sweep, RangeSweep) and not log_scale:
        values = list(sweep.range())  # without its end
        if all(isinstance(value, int) for value in values):
            return IntDistribution(int(values[0]), int(values[-1]), step=int(sweep.step))
        return FloatDistribution(
            float(values[0]), round(float(values[-1]), 10), step=float(sweep.step)
        )
    raise ConfigError(
        f"cannot search {override.input_line}; write {key}=interval(low,high), "
        "range(start,end,step) or choice(a,b)"
    )


def _overrides(params: Mapping[str, Any]) -> list[str]:
    return [f"{key}={_text(value)}" for key, value in params.items()]


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _tell(study: Study, trial: Trial, result: JobReturn) -> None:
    from optuna.trial import TrialState

    if result.status == JobStatus.COMPLETED:
        trial.set_user_attr("run", runs.run_name(result.cfg))  # type: ignore[arg-type]
        study.tell(trial, result.return_value)
    else:
        study.tell(trial, state=TrialState.FAIL)


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
