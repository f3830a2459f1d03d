"""`qs3 tune`: objects, target, search, then what the ordinary sensor says, and two files."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from qs3.config.hydra import build
from qs3.data.store import open_pointset
from qs3.errors import ConfigError, DataError
from qs3.generation.checks import check
from qs3.generation.objects import mesh_items
from qs3.generation.plan import settings as plan_settings
from qs3.generation.recipes import Mesh2Point
from qs3.generation.scan import composed_recipe
from qs3.inference.predictor import load
from qs3.meshes.source import MeshItem
from qs3.sensors.renderers.base import Renderer
from qs3.tuning import parameters
from qs3.tuning.features import ROUGHNESS, Descriptor, Distance, NetFeatures, roughness
from qs3.tuning.remembered import Remembered
from qs3.tuning.scenes import Still, check_recipe, sampled, still_of
from qs3.tuning.search import search, settled
from qs3.tuning.state import State, read_state
from qs3.utils.plural import counted
from qs3.utils.progress import progress_bar, shown

log = logging.getLogger(__name__)

_LEAST = 4  # objects on either side


@dataclass(frozen=True)
class Wanted:
    """What is asked for; see `qs3 tune --help`."""

    target: Path
    out: Path
    objects: int
    held_out: int
    sample: int
    steps: int
    batch: int
    points: int
    features: str
    slopes: str
    parameters: tuple[str, ...]
    rate: float
    seed: int


@dataclass(frozen=True)
class Found:
    """What came of it.

    Attributes:
        keys: of the numbers that were tuned.
        before, after: their values; where the preset has one out of its range, it began there.
        path: distance at each step, of that step's objects, by the ordinary sensor.
        held_out: distances by the ordinary sensor of objects that the search did not see, "before"
            and "after", and "floor", that of as many other clouds of the target.
        trained_on: the same of those that it saw.
        counts: objects of both, and clouds of the target.
        features: what was compared.
    """

    keys: tuple[str, ...]
    before: Mapping[str, float]
    after: Mapping[str, float]
    path: Sequence[float]
    held_out: Mapping[str, float]
    trained_on: Mapping[str, float]
    counts: Mapping[str, int]
    features: str


def tune(wanted: Wanted, overrides: Sequence[str]) -> Found:
    """All steps.

    Args:
        wanted: see the class.
        overrides: of generate.py: domain=, sensor=, views=, meshes=, renderer= ...

    Raises:
        ConfigError, DataError: say which setting or file is to blame.
    """
    cfg = composed_recipe(list(overrides))
    check(cfg)
    recipe = check_recipe(build(cfg.recipe))
    sensor = parameters.check_sensor(recipe.sensor)
    keys = parameters.check_keys(wanted.parameters)
    items = [item for item in mesh_items(cfg) if item.split == "train"]
    trained, held = _drawn(items, wanted)
    target, digest = target_clouds(wanted.target, wanted.sample, wanted.points, wanted.seed)
    describe = descriptor(wanted.features)
    distance = Distance(describe, target)
    settings = _settings(wanted, cfg, trained, digest, keys, describe)
    at = wanted.out.with_suffix(".search.json")
    start = parameters.free(parameters.values_of(sensor, keys)).tolist()
    zeros = [0.0] * len(keys)
    state = read_state(at, settings) or State(settings, start, zeros, list(zeros))
    renderer = Remembered(build(cfg.renderer))
    if state.steps < wanted.steps:
        _go_on(state, keys, wanted, recipe, trained, cfg.seed, renderer, distance, at)
    found = parameters.as_floats(parameters.bounded(torch.tensor(settled(state)), keys))
    judged = {}
    for name, some in (("held_out", held), ("trained_on", trained)):
        stills = [_unseen(recipe, item, cfg.seed, renderer) for item in some]
        judged[name] = _judged(stills, found, distance, wanted)
    return Found(
        keys, parameters.values_of(sensor, keys), found, state.distances,
        judged["held_out"], judged["trained_on"],
        {"trained_on": len(trained), "held_out": len(held), "target": len(target)},
        wanted.features,
    )  # fmt: skip


def _settings(
    wanted: Wanted,
    cfg: DictConfig,
    trained: Sequence[MeshItem],
    digest: str,
    keys: Sequence[str],
    describe: Descriptor,
) -> str:
    """Text of all that decides a search, see `State`; `digest`: of the target."""
    net = {"net": describe.sha256} if isinstance(describe, NetFeatures) else {}
    return json.dumps(
        {
            "recipe": plan_settings(cfg),
            # Not the held-out ones, which only judge; and folders may have objects of one name.
            "objects": [(item.id, item.load().sha256) for item in trained],
            "target": digest,
            "keys": keys,
            **net,
            **{
                name: getattr(wanted, name)
                for name in (
                    "sample",
                    "steps",
                    "batch",
                    "points",
                    "features",
                    "slopes",
                    "rate",
                    "seed",
                )
            },
        },
        sort_keys=True,
    )


def _go_on(
    state: State,
    keys: Sequence[str],
    wanted: Wanted,
    recipe: Mesh2Point,
    items: Sequence[MeshItem],
    seed: int,
    renderer: Renderer,
    distance: Distance,
    at: Path,
) -> None:
    stills: list[Still] = []
    for item in shown(items, "rendering"):
        if wanted.slopes == "twin":
            stills.append(still_of(recipe, item.load(), item.id, seed, renderer))
        else:
            stills.append(_unseen(recipe, item, seed, renderer))
    with progress_bar("steps", total=wanted.steps, done=state.steps) as advance:

        def after(state: State) -> None:
            state.write(at)
            advance()

        search(
            state, keys, stills, distance, steps=wanted.steps, batch=wanted.batch,
            points=wanted.points, rate=wanted.rate, seed=wanted.seed, slopes=wanted.slopes,
            after=after,
        )  # fmt: skip


def descriptor(features: str) -> Descriptor:
    """By its name: roughness, or a run or a net that comes with qs3.

    Raises:
        ConfigError: the net is none that sees clouds in the unit ball.
    """
    if features == ROUGHNESS:
        return roughness
    predictor = load(features)
    if predictor.in_metres:
        raise ConfigError(
            f"features={features} sees sizes, and clouds are compared in the unit ball: take a net "
            "that was trained with data.scale=unit_ball, such as dgcnn-speckle"
        )
    return NetFeatures(predictor.net)


def target_clouds(
    folder: Path, sample: int, points: int, seed: int
) -> tuple[list[Float[Tensor, "n 3"]], str]:
    """Clouds of the part for training of a store, at random, and the store's hash.

    Labels are not looked at.
    """
    data = open_pointset(folder)
    rows = np.flatnonzero(data.splits == "train")
    if len(rows) < _LEAST:
        raise DataError(
            f"{folder} has {counted(len(rows), 'cloud')} in its part for training; 4 are the least"
        )
    drawn = np.random.default_rng(seed).permutation(rows)[:sample]
    return [sampled(data.points[i], points) for i in np.sort(drawn)], data.sha256


def _drawn(items: Sequence[MeshItem], wanted: Wanted) -> tuple[list[MeshItem], list[MeshItem]]:
    """Objects to search with, and others to judge by; all classes alike."""
    count = wanted.objects + wanted.held_out
    if len(items) < count:
        raise ConfigError(
            f"objects={wanted.objects} and held_out={wanted.held_out} are more than the part for "
            f"training has, {counted(len(items), 'mesh', 'meshes')}: ask for fewer, or raise limit="
        )
    order = np.random.default_rng([wanted.seed, 1]).permutation(len(items))[:count]
    drawn = [items[i] for i in order]
    return drawn[: wanted.objects], drawn[wanted.objects :]


def _unseen(recipe: Mesh2Point, item: MeshItem, seed: int, renderer: Renderer) -> Still:
    """For the ordinary sensor alone: without the twin's views."""
    return Still(item.id, recipe, item.load(), seed, renderer, (), np.zeros((2, 3)))


def _judged(
    stills: Sequence[Still], found: Mapping[str, float], distance: Distance, wanted: Wanted
) -> dict[str, float]:
    """Distances of the ordinary sensor's clouds, before and after, of what both can see."""
    pairs = []
    for one in shown(stills, "measuring"):
        try:
            pairs.append([one.measured(values, wanted.points) for values in ({}, found)])
        except DataError as error:
            log.info("%s is left out: %s", one.id, error)
    if len(pairs) < 2:
        raise DataError(
            "the ordinary sensor sees next to nothing of these objects: begin with another preset"
        )
    with torch.no_grad():
        before, after = (float(distance([pair[k] for pair in pairs])) for k in (0, 1))
    return {
        "before": before, "after": after, "objects": len(pairs),
        "floor": distance.floor(len(pairs)),
    }  # fmt: skip
