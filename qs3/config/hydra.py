"""What Hydra needs from us: resolvers, instantiation, plain errors; and the hash of a config.

The hash names a run's folder: the same command always finds its own run.

Importing this module registers the resolvers `${qs3.run_name:}`, `${qs3.wandb_id:}`,
`${qs3.tags:}`, `${qs3.scale:FLOOR}`, `${qs3.classes:FOLDER}`, `${qs3.count:CLASSES}`,
`${qs3.gpu_in_turn:N}` and `${qs3.sha256:FILE}`, and for help texts `${qs3.choices:GROUP}`,
`${qs3.described:GROUP}` and `${qs3.typed:COMMAND}`.
"""

import hashlib
import itertools
import json
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import ValidationError

from qs3.classes import CLASSES, class_list
from qs3.config.location import CONF, PACKAGE, typed
from qs3.errors import ConfigError, Qs3Error
from qs3.utils.files import reading, sha256_file
from qs3.utils.settings import problems

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
    "method.file",  # its content matters, wherever it lies: .sha256
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


def _tags(*, _root_: DictConfig) -> ListConfig:
    """For loggers: method, self-training, net and domains, and whether the target is simulated."""
    names, data = component_names(_root_), _root_.data
    tags = [f"{data.source.name} -> {data.target.name}", *dict.fromkeys(names.values())]
    simulated = ["simulated"] if data.target.get("simulated") else []
    # A node of the config: `--cfg job --resolve` cannot put a plain list in its place.
    return ListConfig([tag for tag in tags if tag != "none"] + simulated)


def _gpu_in_turn(gpus: int | None = None) -> int:
    """The GPU for this job: its number in the sweep, modulo `gpus` (None: all that CUDA finds)."""
    if not in_multirun():
        return 0
    if gpus is None:
        import torch  # counts without occupying a GPU

        gpus = max(1, torch.cuda.device_count())
    return int(HydraConfig.get().job.num) % gpus


def component_names(cfg: DictConfig) -> dict[str, str]:
    """How method, self-training and model were called on the command line (or their classes)."""
    choices = HydraConfig.get().runtime.choices if HydraConfig.initialized() else {}
    selector = cfg.selftraining.get("selector") or {"_target_": "none"}
    nodes = {"method": cfg.method, "selftraining": selector, "model": cfg.model}
    names = {
        group: str(choices.get(group) or node.get("_target_", "none").rsplit(".", 1)[-1].lower())
        for group, node in nodes.items()
    }
    if file := cfg.method.get("file"):  # method=own
        names["method"] = Path(file).stem
    if not has_rounds(OmegaConf.to_container(cfg.selftraining, resolve=False)):
        names["selftraining"] = "none"
    return names


def _sha256(file: str | None) -> str:
    """Hash of a file; "" if there is none: the command that needs it raises."""
    try:
        return file_sha256(file) if file else ""
    except Qs3Error:
        return ""


def _choices(group: str, indent: int = 0) -> str:
    """The choices of a config group, as `a | b`; with `indent` in lines that begin there."""
    text = " | ".join(path.stem for path in _files(group))
    return ("\n" + " " * indent).join(textwrap.wrap(text, 100 - indent)) if indent else text


def _described(group: str, also: str = "") -> str:
    """A line for each choice, of both groups if two are given, with its file's first sentence."""
    both = {path.name for path in _files(also or group)}
    files = [path for path in _files(group) if path.name in both]
    width = max((len(path.stem) for path in files), default=0)
    lines = []
    for path in files:
        head = itertools.takewhile(
            lambda line: line.startswith("#"), path.read_text("utf-8").splitlines()
        )
        words = " ".join(line[1:].strip() for line in head if not line.startswith("# @package"))
        sentence = re.split(r"(?<=[.;])\s", words, maxsplit=1)[0].rstrip(";.")
        short = textwrap.shorten(sentence, 100 - width, placeholder=" ...")
        lines.append(f"  {path.stem:<{width}}  {short}".rstrip())
    return "\n".join(lines)


def _files(group: str) -> list[Path]:
    return sorted(path for path in (CONF / group).glob("*.yaml") if path.stem != "none")


def _classes_of(folder: str) -> list[str] | None:
    """Those of a dataset, if it is there and they are not the ten."""
    meta = Path(folder) / "meta.yaml"
    found = tuple(OmegaConf.select(OmegaConf.load(meta), "classes")) if meta.is_file() else CLASSES
    return None if found == CLASSES else list(found)


_RESOLVERS: dict[str, Callable[..., Any]] = {
    "packaged": lambda: str(PACKAGE / "pretrained"),  # classifiers that come with qs3
    "choices": _choices,
    "described": _described,
    "gpu_in_turn": _gpu_in_turn,
    "tags": _tags,
    "run_name": lambda *, _root_: run_name(_root_),
    "typed": typed,
    "wandb_id": lambda *, _root_: run_name(_root_).replace("/", "-"),
    "count": lambda classes: len(class_list(classes)),
    "classes": _classes_of,
    # What of a cloud in metres a net can see: a floor below the origin is a camera's.
    "scale": lambda z: "metres" if z is None else "seen" if z < 0 else "above_floor",
}
for _name, _resolver in _RESOLVERS.items():
    OmegaConf.register_new_resolver(f"qs3.{_name}", _resolver, replace=True)
OmegaConf.register_new_resolver("qs3.sha256", _sha256, replace=True, use_cache=True)


def build(node: Any, **more: Any) -> Any:
    """`instantiate` with plain containers, and with our own errors as they were raised.

    A TypeError or ValueError of the target becomes a ConfigError that names the place.
    """
    try:
        return instantiate(node, _convert_="all", **more)
    except InstantiationException as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, Qs3Error):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        if isinstance(error.__cause__, TypeError | ValueError):
            place = re.search(r"^full_key: (.+)$", str(error), re.MULTILINE)
            where = place[1] if place else str(error).splitlines()[0]
            if isinstance(error.__cause__, ValidationError):
                raise ConfigError(problems(error.__cause__, where)) from None
            raise ConfigError(f"{where}: {error.__cause__}") from error
        raise


def cli_errors(task: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    """Run `task`; a `Qs3Error` becomes a message without a traceback.

    HYDRA_FULL_ERROR=1 shows the traceback nevertheless.
    """
    try:
        return task(cfg)
    except Qs3Error as error:
        raise CompactHydraException(f"{type(error).__name__}: {error}") from error


def in_multirun() -> bool:
    """Whether this job is one of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def config_sha256(cfg: DictConfig) -> str:
    """64 hex digits over the composed config, without the keys that do not change a result.

    Interpolations are hashed as they are written: what they point to is hashed at its own place,
    or does not matter. But by its value is hashed what comes from outside of the config
    (`${oc.env:NAME}`), or from a `selftraining` without rounds, which is not hashed itself; and a
    method's file by its content.
    """
    plain: Any = OmegaConf.to_container(cfg, resolve=False)
    if "sha256" in (plain.get("method") or {}):
        plain["method"]["sha256"] = cfg.method.sha256
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
    """Hash of a file that the config names."""
    with reading(file):
        return sha256_file(Path(file).expanduser())


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
