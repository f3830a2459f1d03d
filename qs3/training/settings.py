"""What training refuses: settings that would fail late, or without their key. Imports no torch."""

from __future__ import annotations

import os
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from qs3.config.checks import check_bool, check_choice, check_float, check_int, check_keys
from qs3.config.compose import choices
from qs3.config.hydra import component_names, in_multirun, is_given
from qs3.config.location import CONF
from qs3.datamodules.phases import plain_epochs
from qs3.errors import ConfigError
from qs3.evaluation.prior import check_told
from qs3.evaluation.selection_rules import LAST, STUDENT_RULES, check_objective
from qs3.inference import pretrained
from qs3.training.run import Run

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
    "overfit_batches": "each epoch draws other batches; set debug=overfit",
}
"""Arguments of Lightning's trainer that no run can have, and what to set instead."""

_ONNX = "model=features needs an ONNX file"
_FEATURES = "qs3.models.features.features"
_PCFEA = "qs3.selftraining.pcfea.Pcfea"

_NEEDED = {
    **KEYS,
    "data.": (
        *("_target_", "points", "scale", "fps_starts", "val", "sampler", "eval_batch_size"),
        *("cache_dir", "make_source", "clouds_a_split", "clouds_a_class"),
    ),
    "paths.": ("data_dir", "log_dir", "warmup_dir"),
    "trainer.": ("accelerator", "threads"),
    "report.": ("_target_", "pictures"),
    **dict.fromkeys(
        ("model.", "method.", "selftraining.", "protocol.optimizer.", "protocol.augment."),
        ("_target_",),
    ),
}
"""What has to be there; where keys are below one, it has to be several settings."""

_MAY_LACK = ("callbacks", "logger")  # then there are none

_INSTEAD = {
    "selection": "give one, as selection.student=last",
    "evaluation": "give one, as evaluation.rotations=0",
    "report": "for no pictures set report.pictures=false",
    "selftraining": "for no rounds set selftraining=none",
    "protocol.optimizer": "give one, as protocol.optimizer.lr=0.001",
    "protocol.augment": "for clouds as they are set protocol.augment.rotate_z=false, .scale=1, "
    ".shift=0 and .jitter_sigma=0",
}
"""What to do in place of leaving something out, or of null."""


def check_complete(cfg: DictConfig) -> None:
    """Raise ConfigError for the first part or setting that a training reads and is not there."""
    for prefix, keys in _NEEDED.items():
        place = prefix.rstrip(".")
        part: Any = OmegaConf.select(cfg, place) if place else cfg
        if not isinstance(part, DictConfig):
            value = "null" if part is None else part
            raise ConfigError(f"{place}={value}: these are several settings; {_instead(place)}")
        for key in keys:
            if key not in part and key not in _MAY_LACK:
                whole = f"{prefix}{key}"
                raise ConfigError(f"{whole} is not there, and training reads it; {_instead(whole)}")


def _instead(key: str) -> str:
    """What to do about a key that is not there, or null."""
    group = key.removesuffix("._target_")  # of what no file was chosen for
    if group in _INSTEAD:
        return _INSTEAD[group]
    if (CONF / group).is_dir() and len(names := choices(group)) > 1:
        return f"give {group}=NAME, one of {', '.join(names)}"
    return "leave out the word with ~ that deletes it"


def check_settings(cfg: DictConfig) -> None:
    """Raise ConfigError for settings that would otherwise fail late, and without their key."""
    check_complete(cfg)
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
    _check_precision(cfg.trainer)
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


def check_run(run: Run) -> None:
    """Raise ConfigError for settings of which each is right and which do not go together."""
    _check_rounds(run)
    _check_pools(run)
    _check_scale(run)
    _check_frozen(run)
    check_objective(run.cfg.objective)
    _check_processes(run.cfg)


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


def _check_precision(trainer: DictConfig) -> None:
    """Refuse weights of float16, with which the first steps make NaN of every net."""
    if trainer.get("precision") in ("16-true", "transformer-engine-float16"):
        raise ConfigError(
            f"trainer.precision={trainer.precision}: float16 holds nothing below 6e-8, so that the "
            "squares of gradients by which Adam divides round to 0, and weights become NaN; set "
            "trainer.precision=bf16-mixed or 16-mixed, whose weights are float32, or bf16-true"
        )


def _check_rounds(run: Run) -> None:
    """Refuse rounds for the upper bound, two thresholds, and a choice among no rounds' epochs."""
    if run.is_upper_bound and run.scheme.rounds:
        raise ConfigError(
            "method=supervised trains on the target's labels and has no use for pseudo-labels; "
            "set selftraining=none"
        )
    for key in ("selftraining.theta", "selftraining.epsilon"):
        if run.scheme.rounds and run.scheme.share is not None and is_given(key):
            raise ConfigError(
                f"{key} would have no effect: selftraining.share={run.scheme.share} sets the "
                f"threshold of each round; add selftraining.share=null, or leave {key} out"
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
        still = " ".join(f"protocol.augment.{key}={str(STILL[key]).lower()}" for key in changes)
        raise ConfigError(
            "model=features keeps the features of clouds as they are stored, and protocol.augment "
            f"({', '.join(changes)}) changes clouds in each step; set protocol=frozen, and where "
            f"the experiment sets them over it {still}"
        )


def _check_processes(cfg: DictConfig) -> None:
    """Refuse copies of a run that are no processes of it: `train.py` starts those itself."""
    if "TORCHELASTIC_RUN_ID" in os.environ:
        raise ConfigError(
            "torchrun starts several copies of this command, which starts its processes itself: "
            "python train.py ... trainer=ddp trainer.devices=N"
        )
    if (nodes := check_int("trainer.num_nodes", cfg.trainer.get("num_nodes", 1), 1)) > 1:
        raise ConfigError(
            f"trainer.num_nodes={nodes} cannot be had: a run is on one machine; those of a sweep "
            "can be on several, with hydra/launcher=slurm or ray"
        )
    # Lightning would start each further process with the whole sweep's command line.
    devices = cfg.trainer.get("devices", 1)
    one = len(devices) == 1 if isinstance(devices, ListConfig) else str(devices) == "1"
    if not one and in_multirun():
        raise ConfigError(
            "trainer uses several processes (DDP), which cannot be swept with -m; run each seed by "
            "itself, or sweep one-process runs with hydra/launcher=joblib"
        )
