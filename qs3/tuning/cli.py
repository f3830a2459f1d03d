"""`qs3 tune`: a sensor preset whose clouds are like those of an unlabelled target."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError
from qs3.utils.cli import NUMBER, Command, Option, one_of, path, several, text, whole

_PARAMETERS = (
    "ambient",
    "infrared.psf_px",
    "infrared.electrons_at_white",
    "infrared.read_noise_e",
    "infrared.speckle_contrast",
    "infrared.white_level",
)


def _tune(more: Sequence[str], line: str, out: Path, rate: float, **given: Any) -> None:
    if out.suffix != ".yaml":
        raise ConfigError(f"out={out} must end in .yaml: it is a sensor preset")
    if not rate > 0:
        raise ConfigError(f"rate must be > 0, got {rate}")
    if given["batch"] > given["objects"]:
        raise ConfigError("batch= is of the objects= that are searched with: it cannot be larger")
    from qs3.config.preset_base import check_no_base
    from qs3.tuning.command import Wanted, tune
    from qs3.tuning.report import said, save

    base = _base(more)
    check_no_base(out, "sensor", base[0], more)
    found = tune(Wanted(out=out, rate=rate, **given), more)
    for words in said(found):
        print(words)
    for written in save(out, found, base, line):
        print(f"wrote {written}")


def _base(overrides: Sequence[str]) -> list[str]:
    """Defaults of the preset: the sensor that the words choose, which must be a file's, unchanged.

    Raises:
        ConfigError: single values of the sensor are given, too.
    """
    changed = [word for word in overrides if word.lstrip("+~").startswith("sensor.")]
    if changed:
        raise ConfigError(
            f"{changed[0]}: qs3 tune begins with a preset as it is; write values into a file of "
            "conf/sensor and name that, sensor=NAME"
        )
    from omegaconf import OmegaConf

    from qs3.config.compose import choices, composed
    from qs3.generation.scan import composed_recipe

    wanted = OmegaConf.to_container(composed_recipe(list(overrides)).sensor, resolve=True)
    given = [word.partition("=")[2] for word in overrides if word.startswith("sensor=")]
    searched = [word for word in overrides if word.startswith("hydra.searchpath=")]
    for name in given or [name for name in choices("sensor") if name != "none"]:
        sensor = composed(None, *searched, f"+sensor={name}").sensor
        if OmegaConf.to_container(sensor, resolve=True) == wanted:
            return [name]
    raise ConfigError("the domain's sensor is no file of conf/sensor: name one, sensor=NAME")


TUNE = Command(
    "qs3 tune",
    "a sensor preset whose clouds are like those of an unlabelled target",
    _tune,
    (
        Option("target", path("FOLDER"), "the target's dataset", required=True),
        Option("out", path("FILE"), "the preset, conf/sensor/NAME.yaml", required=True),
        Option("objects", whole(4), "objects of the source to search with", 40),
        Option("held_out", whole(4), "other objects, to judge the result by", 20),
        Option("sample", whole(4), "clouds of the target to compare with", 256),
        Option("steps", whole(), "steps of the search", 60),
        Option("batch", whole(2), "objects a step", 8),
        Option("points", whole(64), "of a cloud", 1024),
        Option(
            "features",
            text("NAME|RUN"),
            "roughness, or a net: a run, or dgcnn-speckle",
            "roughness",
        ),
        Option(
            "slopes",
            one_of("differences", "twin"),
            "how slopes are found, see below",
            "differences",
        ),
        Option("parameters", several(text("KEY")), "that are tuned", _PARAMETERS),
        Option(
            "rate", NUMBER, "step size of Adam, on the logit of a number's place in its range", 0.15
        ),
        Option("seed", whole(0), "of draws and noise (default 0)", 0),
    ),
    (
        "qs3 tune domain=specklenet10 views=1 renderer=mitsuba target=data/kinectsim10 \\",
        "    out=conf/sensor/tuned.yaml",
        "qs3-generate domain=specklenet10 views=1 renderer=mitsuba sensor=tuned",
    ),
    about="""
Adam lowers the squared MMD of the features of the source's clouds to those of the target's, of
which no label is read. Clouds are made by the ordinary sensor, whose random numbers stay. Slopes
are central differences (2 clouds a number, object and step), or those of the sensor's
differentiable twin (qs3.sensors.gradients): one cloud for all numbers, but the twin has no holes,
no filters and another matcher, so that its slopes can point the wrong way. Numbers stay within
physical ranges. The report has the distances before and after, also of objects that the search did
not see. A smaller distance need not mean a better classifier: train with both, as
experiment=tuned_s2k.

It can be interrupted at any moment: the search is in OUT.search.json, and the same command goes on.
""",
    others={"": "of qs3-generate: domain= sensor= views= meshes= renderer="},
    line=True,
)
