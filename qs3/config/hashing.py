"""The hash of a config, which names a run's folder: the same command always finds its own run."""

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from qs3.errors import MissingDataError
from qs3.utils.files import sha256_file

# Keys that do not change a result: where things lie, what is shown, how data would be made, and the
# seed, which is in the folder's name. Everything else is hashed, so two different runs never share
# a folder. (Other data, wherever they lie, have another hash, which `started.json` guards.)
_UNHASHED = (
    "seed",
    "paths",
    "logger",
    "hydra",
    "force",
    "callbacks.progress",
    "report",
    "objective",
    "trainer.gpus",  # which of several GPUs trains a run
    "trainer.cuda_graphs",  # the same kernels, started at once
    "data.cache_dir",
    "data.make_source",
    *("method.file", "model.file"),  # their content matters, wherever they lie: .sha256
    *(
        f"data.{domain}.{key}"
        for domain in ("source", "target")
        for key in (
            *("path", "twin_of", "title", "symbol", "unit"),
            *("published.folder", "published.file", "published.on_error"),
            *("synthesis", "how_to_get", "make", "stand_in"),
        )
    ),
)
_FROM_OUTSIDE = re.compile(r"\$\{\s*oc\.")
_NO_ROUNDS = "qs3.datamodules.phases.no_rounds"


def config_sha256(cfg: DictConfig) -> str:
    """64 hex digits over the composed config, without the keys that do not change a result.

    Interpolations are hashed as they are written: what they point to is hashed at its own place,
    or does not matter. But by its value is hashed what comes from outside of the config
    (`${oc.env:NAME}`), or from a `selftraining` without rounds, which is not hashed itself; and a
    method's or a model's file by its content.
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=False)
    for group in ("method", "model"):
        if "sha256" in (plain.get(group) or {}):
            plain[group]["sha256"] = cfg[group].sha256
    for key in _UNHASHED:
        _leave_out(plain, key)
    plain.setdefault("callbacks", {})  # ~callbacks leaves nothing out
    plain = _with_values(plain, cfg, "", _FROM_OUTSIDE)
    if not has_rounds(plain.get("selftraining")):  # its other settings are not read
        plain["selftraining"] = None
        plain = _with_values(plain, cfg, "", _from(["selftraining"]))
    trainer = plain.get("trainer")
    devices = trainer.get("devices") if isinstance(trainer, dict) else None
    if isinstance(devices, list) and len(devices) == 1:
        trainer["devices"] = 1
    text = json.dumps(plain, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def with_values(cfg: DictConfig, keys: Sequence[str]) -> Any:
    """The config as nested dicts, with values in place of interpolations of these keys."""
    return _with_values(OmegaConf.to_container(cfg, resolve=False), cfg, "", _from(keys))


def file_sha256(file: str) -> str:
    """Hash of a file that the config names; MissingDataError if it cannot be read."""
    try:
        return sha256_file(Path(file).expanduser())
    except OSError as error:
        raise MissingDataError(f"{file} cannot be read ({error})") from error


def _leave_out(plain: Any, key: str) -> None:
    """Take a key out of nested dicts, if it is there."""
    *parents, leaf = key.split(".")
    for parent in parents:
        plain = plain.get(parent) if isinstance(plain, dict) else None
    if isinstance(plain, dict):
        plain.pop(leaf, None)


def _from(keys: Sequence[str]) -> re.Pattern[str]:
    """Finds interpolations of keys and what lies below: `${A}`, `${..A.b}`, `${oc.select:A.b}`."""
    names = (re.escape(key).replace(r"\.", r"[.\[]") for key in keys)
    return re.compile(rf"\$\{{[^}}]*(?<![\w\]]\.)(?<!\w)(?:{'|'.join(names)})\b")


def _with_values(node: Any, cfg: DictConfig, place: str, which: re.Pattern[str]) -> Any:
    """The same, with values in place of the interpolations that the pattern finds."""
    if isinstance(node, dict):
        begin = f"{place}." if place else ""
        return {key: _with_values(v, cfg, f"{begin}{key}", which) for key, v in node.items()}
    if isinstance(node, list):
        return [_with_values(value, cfg, f"{place}[{i}]", which) for i, value in enumerate(node)]
    if isinstance(node, str) and which.search(node):
        found = OmegaConf.select(cfg, place)
        return OmegaConf.to_container(found, resolve=True) if OmegaConf.is_config(found) else found
    return node


def config_hash(cfg: DictConfig) -> str:
    """The first 8 digits of `config_sha256`, for names (`check_config` compares all 64)."""
    return config_sha256(cfg)[:8]


def has_rounds(selftraining: Any) -> bool:
    """Whether a group `selftraining`, as nested dicts, does something."""
    if not isinstance(selftraining, dict):
        return False
    return selftraining.get("_target_") != _NO_ROUNDS and selftraining.get("rounds") != 0


def run_name(cfg: DictConfig) -> str:
    """`<experiment_name>/seed<seed>-<hash>`, relative to `paths.log_dir`."""
    return f"{cfg.experiment_name}/seed{cfg.seed}-{config_hash(cfg)}"


def run_folder(cfg: DictConfig) -> Path:
    """The folder of the run that `cfg` describes, whether it exists or not."""
    return Path(cfg.paths.log_dir).resolve() / run_name(cfg)
