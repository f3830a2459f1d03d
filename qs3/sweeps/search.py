"""A search over hyper-parameters that never looks at a label of the target: Optuna's TPE.

    ask Optuna for settings -> launch runs -> read the objective that each returns -> tell Optuna

The objective is a validator of `qs3.evaluation`: accuracy is refused, and so is to vary what says
how runs are judged (`check_varied`). The study lies in a file next to the runs, so that the same
command goes on with it: trials that have finished are not repeated, those that failed or were
interrupted are tried again. One that diverged is a poor trial, not a failed one. What Optuna draws
for a trial follows from (seed, number of the trial): an interrupted search proposes what an
uninterrupted one would have.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
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
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig, OmegaConf

from qs3.config import hashing
from qs3.config.compose import quoted
from qs3.config.location import typed
from qs3.errors import ConfigError
from qs3.evaluation.validators import LABEL_FREE
from qs3.sweeps.listed_jobs import ListedJobs, OverLauncher
from qs3.sweeps.ray_launcher import RayLauncher
from qs3.training.provenance import check_finished
from qs3.utils.locks import locked
from qs3.utils.text_table import aligned

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import Trial

VARIED = ("method", "model", "protocol", "selftraining")
"""First words of the keys that may differ between runs of which an objective chooses one."""

FAILED = "failed"
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
        self.trials, self.at_once, self.seed, self.random = trials, at_once, seed, random
        self.folder = Path(folder)

    def run(self, arguments: list[str]) -> list[JobReturn]:
        """Search until there are as many trials as were asked for; print the report."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        loader = self.hydra_context.config_loader
        fixed, searched = split(arguments, self.params, OverridesParser.create(loader))
        cfg = loader.load_sweep_config(self.config, list(fixed))
        if cfg.objective is None:
            raise ConfigError("a search needs an objective, such as objective=infomax")
        space = {key: distribution(one) for key, one in searched.items()}
        study = self._study(cfg, space)
        lock = self.file.with_name(f".{self.file.stem}.lock")
        with locked(lock, f"another process is searching in {self.file}"):
            # A trial without an end was interrupted: the lock says that nobody runs it now.
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

        Objectives of two datasets say nothing about settings. One run stands for all.
        """
        from optuna.trial import TrialState

        loader = self.hydra_context.config_loader
        for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)):
            one = loader.load_sweep_config(self.config, [*fixed, *overrides(words(trial.params))])
            one = OmegaConf.masked_copy(one, [str(key) for key in one if key != "hydra"])
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

        # Trials that are still running count as poor ones, so that those of a batch differ.
        study.sampler = TPESampler(
            seed=self.seed + 1000 * _count(study), n_startup_trials=self.random, constant_liar=True
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
                f"{one.input_line}: with objective= only {', '.join(VARIED)} may vary, so that "
                "all runs are judged in the same way"
            )


def distribution(one: Override) -> BaseDistribution:
    """What Optuna calls a sweep of Hydra's: whole numbers if both ends are.

    Raises:
        ValueError: Optuna's, for ends or values that cannot be.
    """
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    sweep: Any = one.value()
    if isinstance(sweep, ChoiceSweep):
        plain = [each.text if isinstance(each, QuotedString) else each for each in sweep.list]
        return CategoricalDistribution(plain)  # type: ignore[arg-type]
    more: dict[str, Any] = {}
    if isinstance(sweep, IntervalSweep):
        low, high, more["log"] = sweep.start, sweep.end, "log" in sweep.tags
    elif isinstance(sweep, RangeSweep):
        values = list(sweep.range())  # without its end
        low, high, more["step"] = values[0], round(values[-1], 10), sweep.step
    else:
        raise ConfigError(f"cannot search {one.input_line}; write interval, range or choice")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, **more)
    return FloatDistribution(float(low), float(high), **more)  # type: ignore[arg-type]


def words(params: Mapping[str, Any]) -> dict[str, str]:
    """A trial's values in Hydra's grammar: numbers with six digits, text quoted if need be."""
    return {
        key: quoted(one) if isinstance(one, str) else _plain(one) for key, one in params.items()
    }


def _plain(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def overrides(words: Mapping[str, str]) -> list[str]:
    """The words of a command line."""
    return [f"{key}={word}" for key, word in words.items()]


@dataclass(frozen=True)
class Tried:
    """A trial.

    Attributes:
        number: of the trial.
        params: by key what was varied, in Hydra's grammar.
        value: of the objective; None if it failed or diverged.
        run: the name of its run, "failed" or "diverged: <name>".
    """

    number: int
    params: Mapping[str, str]
    value: float | None
    run: str

    @staticmethod
    def of(number: int, params: Mapping[str, str], value: float | None, run: str) -> Tried:
        """A trial with what its run returned: None if that failed, NaN if it diverged."""
        if value is None:
            return Tried(number, params, None, FAILED)
        if not math.isfinite(value):
            return Tried(number, params, None, f"diverged: {run}")
        return Tried(number, params, value, run)


def report(headline: str, objective: str, tried: Sequence[Tried], fixed: Sequence[str]) -> str:
    """A table of all trials, in order, without any accuracy; `fixed`: overrides that all share."""
    keys = list(dict.fromkeys(key for one in tried for key in one.params))
    rows = [("trial", objective, *keys, "run")]
    for one in tried:
        value = "-" if one.value is None else f"{one.value:.4f}"
        values = (one.params.get(key, "-") for key in keys)
        rows.append((str(one.number), value, *values, one.run))
    lines = [headline, *aligned(rows)]
    judged = [one for one in tried if one.value is not None]
    if judged:
        sign = 1 if LABEL_FREE[objective].higher_is_better else -1
        best = max(judged, key=lambda one: sign * (one.value or 0.0))  # the first one wins a tie
        search = ("hparams_search=", "objective=", "seed=")
        kept = [word for word in fixed if not word.startswith(search)]
        command = shlex.join([*kept, *overrides(best.params), "seed=0,1,2"])
        lines.append(f"Best: trial {best.number}. With several seeds:")
        lines.append(typed(f"  python train.py -m {command}"))
    return "\n".join(lines)


def _tell(study: Study, trial: Trial, result: JobReturn) -> None:
    from optuna.trial import TrialState

    value, run = None, ""
    if result.status == JobStatus.COMPLETED:
        value, run = float(result.return_value), hashing.run_name(result.cfg)  # type: ignore[arg-type]
    one = Tried.of(trial.number, words(trial.params), value, run)
    trial.set_user_attr("run", one.run)
    if one.value is not None:
        study.tell(trial, one.value)
    else:  # a pruned trial is a poor one to TPE, and is not tried again: it would diverge again
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
