"""The stories of the two commands, top to bottom."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import sys
from collections.abc import Iterator
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from qs3.config.checks import check_bool, check_choice, check_float, check_int, check_keys
from qs3.config.hydra import build, component_names, in_multirun
from qs3.data.ensure_source import check_or_make
from qs3.datamodules.phases import plain_epochs
from qs3.errors import ConfigError
from qs3.evaluation.estimates_text import in_words
from qs3.evaluation.prior import check_told
from qs3.evaluation.selection_rules import LAST, STUDENT_RULES, check_objective, chosen_in_words
from qs3.inference import pretrained
from qs3.runs import folder as runs
from qs3.runs.metrics import METRICS, RunMetrics, read_metrics, write_metrics
from qs3.runs.predictions import OF_FILES
from qs3.training.reuse import refuse_changed
from qs3.training.run import Run, run_of
from qs3.utils.locks import owned

log = logging.getLogger(__name__)

KEYS = {
    "": (
        *("data", "model", "method", "protocol", "selftraining", "selection", "evaluation"),
        *("trainer", "callbacks", "logger", "paths", "report", "experiment_name", "seed"),
        *("num_classes", "weights", "ckpt_path", "force", "compile", "objective"),
    ),
    "protocol.": (
        *("epochs", "steps", "batch_size", "optimizer", "schedule", "smoothing", "regulariser"),
        "augment",
    ),
    "selection.": ("teacher", "student"),
    "evaluation.": ("norms", "prior", "prior_power", "rotations"),
}
"""The settings that this command reads itself; all others are arguments of what is built."""

TEACHERS = ("source_val", "last", "given")
SCHEDULES = ("cosine", "plateau")
NORMS = ("trained", "adabn", "alpha_bn", "tent")
UNIT_BALL_ONLY = {
    "qs3.models.simpleview.simpleview": "its cameras stand 1.4 from the cloud's middle and would "
    "lose a large object's points"
}
"""Parts that cannot see metres, by name (their modules import torch), and why."""

CENTRED_ONLY = {
    "qs3.methods.gast.Gast": "it turns parts of clouds about their middle",
    "qs3.methods.defrec.DefRec": "it deforms parts of clouds in a cube about their middle",
    "qs3.methods.mlsp.Mlsp": "it masks parts of clouds in a cube about their middle",
}
"""Parts that cannot see heights, likewise."""

STILL = {
    **{"crop": 1.0, "drop_regions": 0, "rotate_z": False, "scale": 1.0},
    **{"shift": 0.0, "lift": 0.0, "jitter_sigma": 0.0},
}
"""Settings of `protocol.augment` that leave clouds as they are."""

NOT_TAKEN = {
    **dict.fromkeys(
        ("max_epochs", "min_epochs", "max_steps", "min_steps", "max_time"),
        "a run is its warm-up and its rounds; set protocol.epochs and protocol.steps, and "
        "selftraining.rounds, .epochs and .steps",
    ),
    **dict.fromkeys(
        ("check_val_every_n_epoch", "val_check_interval"),
        "each epoch is judged once, at its end, and teachers are chosen by that; set "
        "trainer.limit_val_batches where it takes long",
    ),
    **dict.fromkeys(
        (
            "log_every_n_steps",
            "num_sanity_val_steps",
            "reload_dataloaders_every_n_epochs",
            "use_distributed_sampler",
            "enable_progress_bar",
            "enable_model_summary",
        ),
        "a training needs its own, and it would do nothing; leave it out",
    ),
    **dict.fromkeys(
        ("limit_test_batches", "limit_predict_batches"),
        "all clouds of the target's test are judged; leave it out",
    ),
    "fast_dev_run": "nothing of it would be saved; set debug=fast",
}
"""Arguments of Lightning's trainer that no run can have, and what to set instead."""

_ONNX = "model=features needs an ONNX file"
_FEATURES = "qs3.models.features.features"
_PCFEA = "qs3.selftraining.pcfea.Pcfea"


def train(cfg: DictConfig) -> RunMetrics:
    """Train, continue or skip the run that `cfg` describes; returns what `metrics.json` holds.

    Everything that can be wrong with the settings or the data is found before torch is imported.
    """
    _check_settings(cfg)
    run = run_of(cfg)
    _check_rounds(run)
    _check_pools(run)
    _check_scale(run)
    _check_frozen(run)
    check_objective(cfg.objective)
    _refuse_ddp_in_multirun(cfg)
    if int(os.environ.get("LOCAL_RANK", 0)) > 0:  # DDP: the first process owns the folder
        with _wandb_forgotten():
            return _fit(run)

    _warn_of_one_domain(run)
    with owned(run.folder):
        if cfg.force:
            runs.clear(run.folder)
        metrics = read_metrics(run.folder)
        if metrics is None:
            run.target.tell_of_judging("data.target.")
            with _wandb_forgotten():
                metrics = _fit(run)
                write_metrics(run.folder, metrics)
                _report(run)
        else:
            refuse_changed(run, metrics)
            log.info("already finished (force=true repeats it)")
    log.info("%s", headline(metrics) if cfg.objective is None else judged(cfg, metrics))
    if (run.folder / OF_FILES).is_file():
        log.info("the class of each file: %s", run.folder / OF_FILES)
    log.info("see %s", run.folder / METRICS)
    return metrics


def objective_of(cfg: DictConfig, metrics: RunMetrics) -> float | None:
    """What a search over hyper-parameters looks at; None if there is no search.

    NaN for a run that has diverged: it is finished, and would diverge again.

    Raises:
        ConfigError: the finished run has no such figure.
    """
    if cfg.objective is None:
        return None
    if cfg.objective not in metrics.validators:
        raise ConfigError(
            f"objective={cfg.objective} needs a target with two training clouds or more"
        )
    value = metrics.validators[cfg.objective]
    return math.nan if value is None else value


def judged(cfg: DictConfig, metrics: RunMetrics) -> str:
    """The result of a search's trial in one line: no accuracy, it would be nothing to choose by."""
    value = metrics.validators.get(cfg.objective)
    text = "none: the net has diverged" if value is None else f"{value:.4f}"
    return f"{metrics.experiment}, seed {metrics.seed}: objective={cfg.objective} {text}"


def headline(metrics: RunMetrics) -> str:
    """The result in one line; says what the data are made of, and when the target is simulated."""
    final, run = metrics.final, f"{metrics.experiment}, seed {metrics.seed}: "
    if metrics.diverged:
        run += "the net has diverged, its predictions are no numbers; "
    target = metrics.target_text
    if final.accuracy is None:
        counts = ", ".join(f"{name} {count}" for name, count in final.predicted.items() if count)
        estimate = in_words(metrics.quality)
        return (
            f"{run}no labels to judge {target} by; predicted {counts}"
            f"{f'; {estimate}' if estimate else ''}; data: {metrics.data_text}{_chosen(metrics)}"
        )
    return (
        f"{run}accuracy {final.accuracy:.1%}, balanced {final.balanced_accuracy:.1%} "
        f"on {target}, majority rate {final.majority_rate:.1%}{_told(metrics)}; "
        f"data: {metrics.data_text}"
        f"{_chosen(metrics)}"
    )


def _told(metrics: RunMetrics) -> str:
    """That predictions were told how common classes are."""
    return "; with evaluation.prior" if metrics.evaluation.prior else ""


def _chosen(metrics: RunMetrics) -> str:
    """How teacher and student were selected, for the end of the headline."""
    teacher, student = map(chosen_in_words, (metrics.selection.teacher, metrics.selection.student))
    if teacher == student:  # no rounds
        return f"; selected by {teacher}"
    return f"; teacher selected by {teacher}; student by {student}"


def _fit(run: Run) -> RunMetrics:
    check_or_make(run.source, run.target, run.cfg.data.make_source)
    from qs3.training.fit import fit  # torch and Lightning from here on

    return fit(run)


def _report(run: Run) -> None:
    """Hand the finished run to what `report` names, e.g. its pictures: training imports none."""
    build(run.cfg.report)(run.folder, OmegaConf.to_container(run.cfg, resolve=False))


@contextlib.contextmanager
def _wandb_forgotten() -> Iterator[None]:
    """End wandb's run after the block: it would live on into the next job of a multirun."""
    try:
        yield
    finally:
        if "wandb" in sys.modules:
            sys.modules["wandb"].finish()
            os.environ.pop("WANDB_MODE", None)  # set by Lightning's logger when offline


_SEVERAL = {
    "selection": "selection.student=last",
    "evaluation": "evaluation.rotations=0",
    "report": "report.pictures=false",
}


def _check_settings(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that would otherwise fail late, and without their key."""
    for key, one in _SEVERAL.items():
        if cfg[key] is None:
            raise ConfigError(f"{key}=null: these are several settings; give one, as {one}")
    for key in ("data.source", "data.target"):
        if not isinstance(domain := OmegaConf.select(cfg, key), DictConfig):
            raise ConfigError(
                f"{key} must be a domain of conf/domain, got {domain!r}; give domain@{key}=NAME"
            )
    _check_keys(cfg)
    _check_names(cfg)
    check_choice("selection.teacher", cfg.selection.teacher, TEACHERS)
    if cfg.selection.teacher == "given" and cfg.weights is None:
        raise ConfigError(
            "selection.teacher=given: weights= names no classifier; give a run's folder, or one "
            f"that comes with qs3 ({', '.join(pretrained.names())})"
        )
    check_choice("selection.student", cfg.selection.student, STUDENT_RULES)
    for key, least in (
        ("data.points", 1),
        ("data.fps_starts", 1),
        ("data.eval_batch_size", 1),
        ("evaluation.rotations", 0),
        ("protocol.batch_size", 2),  # batch norm needs two clouds
    ):
        check_int(key, OmegaConf.select(cfg, key), least)
    for key in ("data.clouds_a_class", "data.clouds_a_split", "trainer.threads"):
        value = OmegaConf.select(cfg, key)
        if value is not None and (key, value) != ("trainer.threads", "auto"):
            check_int(key, value, 1)
    for key in ("data.make_source", "force", "compile"):
        check_bool(key, OmegaConf.select(cfg, key))
    check_bool("trainer.cuda_graphs", cfg.trainer.get("cuda_graphs", True))
    _check_products(cfg.trainer)
    if (exactly := cfg.trainer.get("deterministic")) not in (None, "warn"):
        check_bool("trainer.deterministic", exactly)
    _check_limits(cfg.trainer)
    if cfg.report.pictures != "auto":
        check_bool("report.pictures", cfg.report.pictures)
    if cfg.ckpt_path is not None and not isinstance(cfg.ckpt_path, str):
        raise ConfigError(f"ckpt_path must be last or a path, got {cfg.ckpt_path!r}")
    if cfg.ckpt_path is not None and cfg.force:
        raise ConfigError(
            "force=true begins the run anew and ckpt_path goes on with one; give one of them"
        )
    for group, what in (("method", "method=own needs a Python file"), ("model", _ONNX)):
        if "sha256" in cfg[group] and not cfg[group].sha256:
            file = cfg[group].file
            why = f"{group}.file={file} cannot be read" if file else f"{group}.file is not set"
            raise ConfigError(f"{why}; {what}, {group}.file=PATH")
    check_choice("evaluation.norms", cfg.evaluation.norms, NORMS)
    power = check_float("evaluation.prior_power", cfg.evaluation.prior_power)
    check_told(cfg.evaluation.prior, power, "evaluation.prior")
    check_choice("protocol.schedule", cfg.protocol.schedule, SCHEDULES)
    highest = 1 - 1 / check_int("num_classes", cfg.num_classes, 2)  # there all classes are alike
    if not 0 <= check_float("protocol.smoothing", cfg.protocol.smoothing) <= highest:
        raise ConfigError(
            f"protocol.smoothing must lie in [0, {highest:g}], got {cfg.protocol.smoothing}"
        )
    check_float("protocol.regulariser", cfg.protocol.regulariser, ">= 0")
    if "lr" in cfg.protocol.optimizer:
        check_float("protocol.optimizer.lr", cfg.protocol.optimizer.lr)


def _check_keys(cfg: DictConfig) -> None:
    """Refuse keys that nothing reads; at the top those that no other value is made of."""
    text = OmegaConf.to_yaml(cfg, resolve=False)
    for prefix, known in KEYS.items():
        found: Any = OmegaConf.select(cfg, prefix.rstrip(".")) if prefix else cfg
        used = [key for key in found if f"${{{key}}}" in text or f"${{{key}." in text]
        keys = [str(key) for key in found if prefix or key not in used]
        check_keys(prefix, keys, known)


def _check_names(cfg: DictConfig) -> None:
    """Refuse names that YAML reads as something else than text, and such as are no folder's."""
    for key in ("experiment_name", "data.source.name", "data.target.name"):
        name = OmegaConf.select(cfg, key)
        if not isinstance(name, str) or not name:
            raise ConfigError(f"{key} must be text, got {name!r}; with quotes: {key}=\"'{name}'\"")
    name = cfg.experiment_name
    if name in (".", "..") or "/" in name:
        raise ConfigError(f"experiment_name={name}: it is a folder below paths.log_dir, one name")


def _check_limits(trainer: DictConfig) -> None:
    """Refuse epochs of no batches, and what ends or judges a run elsewhere than at its phases."""
    if trainer.get("limit_train_batches") == 0:
        raise ConfigError(
            "trainer.limit_train_batches must leave a batch, or nothing is trained; null takes all "
            "of an epoch's, and protocol.steps says how many there are"
        )
    if trainer.get("limit_val_batches") == 0:
        raise ConfigError(
            "trainer.limit_val_batches must leave a batch: held-out labelled clouds say what the "
            "net is worth; null takes all of them"
        )
    for key, instead in NOT_TAKEN.items():
        if (value := trainer.get(key)) is not None:
            raise ConfigError(f"trainer.{key}={value} cannot be had: {instead}")


def _check_products(trainer: DictConfig) -> None:
    """Refuse a rounding that is not one, and one that would be a GPU's on the CPU."""
    key, rounding = "trainer.float32_matmul", trainer.get("float32_matmul", "highest")
    check_choice(key, rounding, ("highest", "high"))
    if rounding == "high" and trainer.accelerator == "cpu":
        raise ConfigError(
            f"{key}=high rounds a GPU's products, and trainer.accelerator is cpu; set "
            "trainer=gpu, or leave it at highest"
        )


def _check_rounds(run: Run) -> None:
    """Refuse rounds for the upper bound, and a choice among epochs of rounds there are not."""
    if run.is_upper_bound and run.scheme.rounds:
        raise ConfigError(
            "method=supervised trains on the target's labels and has no use for pseudo-labels; "
            "set selftraining=none"
        )
    rule = run.cfg.selection.student
    if rule != LAST and not run.scheme.rounds:
        raise ConfigError(
            f"selection.student={rule} chooses among the epochs of the last round, and this run "
            "has no rounds: selection.teacher decides what is reported; set "
            f"selection.student={LAST}, or a selftraining with rounds"
        )


def _check_pools(run: Run) -> None:
    """Refuse PCFEA that would make no pool in any epoch."""
    method = run.cfg.method
    if method.get("_target_") == _PCFEA and "plain" in method:
        plain_epochs(check_float("method.plain", method.plain, "[0, 1)"), run.phases.warmup)


def _check_scale(run: Run) -> None:
    """Refuse metres or heights for clouds that have none, and for parts that cannot see them."""
    cfg = run.cfg
    used = (run.target,) if run.is_upper_bound else (run.source, run.target)
    for domain in used:
        domain.check_scale(cfg.data.scale)
    for table, allowed in (
        (UNIT_BALL_ONLY, ("unit_ball",)),
        (CENTRED_ONLY, ("metres", "unit_ball")),
    ):
        for group in ("method", "model"):
            why = table.get(cfg[group].get("_target_"))
            if why and cfg.data.scale not in allowed:
                raise ConfigError(
                    f"data.scale={cfg.data.scale} and {group}={component_names(cfg)[group]}: {why};"
                    f" set data.scale={allowed[0]}, or choose another {group}"
                )


def _check_frozen(run: Run) -> None:
    """Refuse augmentation of clouds whose features are kept: no cloud would come twice."""
    augment = run.cfg.protocol.augment
    changes = [key for key, value in STILL.items() if augment.get(key, value) != value]
    if run.cfg.model.get("_target_") == _FEATURES and changes:
        raise ConfigError(
            "model=features keeps the features of clouds as they are stored, and protocol.augment "
            f"({', '.join(changes)}) changes clouds in each step; set protocol=frozen"
        )


def _warn_of_one_domain(run: Run) -> None:
    if run.source.folder == run.target.folder and not run.is_upper_bound:
        log.warning(
            "data.source (%s) and data.target (%s) are the same dataset: the target's training "
            "labels are used, so this is not adaptation",
            run.source.name,
            run.target.name,
        )


def _refuse_ddp_in_multirun(cfg: DictConfig) -> None:
    """Lightning would start each further process with the whole sweep's command line."""
    devices = cfg.trainer.get("devices", 1)
    one = len(devices) == 1 if isinstance(devices, ListConfig) else str(devices) == "1"
    several = not one or cfg.trainer.get("num_nodes", 1) > 1
    if several and in_multirun():
        raise ConfigError(
            "trainer uses several processes (DDP), which cannot be swept with -m; run each seed by "
            "itself, or sweep one-process runs with hydra/launcher=joblib"
        )
