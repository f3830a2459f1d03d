"""What Hydra needs from us: resolvers, instantiation, plain errors.

Importing this module registers the resolvers `${qs3.run_name:}`, `${qs3.wandb_id:}`,
`${qs3.tags:}`, `${qs3.gpu_in_turn:N}` and `${qs3.sha256:FILE}`, and for help texts
`${qs3.choices:GROUP}`, `${qs3.described:GROUP}` and `${qs3.typed:COMMAND}`.
"""

import itertools
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException, InstantiationException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import ValidationError

from qs3.config import hashing
from qs3.config.location import CONF, PACKAGE, typed
from qs3.errors import ConfigError, Qs3Error
from qs3.utils.settings import problems


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
    if not hashing.has_rounds(OmegaConf.to_container(cfg.selftraining, resolve=False)):
        names["selftraining"] = "none"
    return names


def _sha256(file: str | None) -> str:
    """Hash of a file; "" if there is none: the command that needs it raises."""
    try:
        return hashing.file_sha256(file) if file else ""
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


_RESOLVERS: dict[str, Callable[..., Any]] = {
    "packaged": lambda: str(PACKAGE / "pretrained"),  # classifiers that come with qs3
    "choices": _choices,
    "described": _described,
    "gpu_in_turn": _gpu_in_turn,
    "tags": _tags,
    "run_name": lambda *, _root_: hashing.run_name(_root_),
    "typed": typed,
    "wandb_id": lambda *, _root_: hashing.run_name(_root_).replace("/", "-"),
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
