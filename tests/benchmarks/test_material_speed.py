"""What materials and the light above cost: processor time of a whole object of specklenet10.

python -m pytest tests/benchmarks/test_material_speed.py --benchmark-enable -s

The baseline is the same objects matt and in even light, in the same process and in turn. Processor
time and not time: it hardly depends on what else the machine does.
"""

from __future__ import annotations

import time

import numpy as np
import pytest
from omegaconf import OmegaConf
from pytest_benchmark.fixture import BenchmarkFixture

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.generation.objects import mesh_items
from qs3.generation.workers import Job, scan_one
from qs3.meshes.source import MeshItem
from qs3.sensors.renderers.base import Renderer
from qs3.sensors.renderers.mitsuba import MitsubaRenderer

WORDS = {
    "matt": (),
    "mixed": ("materials=mixed",),
    "area and mixed": ("materials=mixed", "light=area"),
}
CORES = 2


def job(*words: str) -> tuple[Job, list[MeshItem]]:
    """What a worker of `generate.py domain=specklenet10` is given, and the meshes."""
    cfg = composed("generate", "domain=specklenet10", "renderer=mitsuba", "limit=1", *words)
    assert OmegaConf.select(cfg, "renderer.samples") == 16
    return Job(build(cfg.recipe), MitsubaRenderer, cfg.seed), mesh_items(cfg)


def processor_s(one: Job, renderer: Renderer, item: MeshItem) -> float:
    """Of one object from its mesh to its cloud."""
    begin = time.process_time()
    assert scan_one(one, renderer, item).cloud is not None
    return time.process_time() - begin


@pytest.mark.timeout(3600)
def test_objects_with_materials_and_without(
    benchmark: BenchmarkFixture, capsys: pytest.CaptureFixture
) -> None:
    renderer = MitsubaRenderer(samples=16)
    if renderer.variant.startswith("scalar_"):
        pytest.skip("no compiled variant works here")
    jobs = {name: job(*words)[0] for name, words in WORDS.items()}
    items = [item for item in job()[1] if item.split == "train"]
    first = benchmark.pedantic(processor_s, (jobs["mixed"], renderer, items[0]), rounds=1)
    assert first > 0
    if not benchmark.enabled:
        return
    for one in jobs.values():  # traces and compiles their kernels
        processor_s(one, renderer, items[0])
    spent: dict[str, list[float]] = {name: [] for name in jobs}
    for item in items:
        for name, one in jobs.items():
            spent[name].append(processor_s(one, renderer, item))
    means = {name: float(np.mean(each)) for name, each in spent.items()}
    benchmark.extra_info["processor_s_an_object"] = means
    with capsys.disabled():
        for name, mean in means.items():
            print(  # noqa: T201
                f"\n{name}: {mean:.3f} core-seconds an object, {mean / means['matt']:.2f} of matt, "
                f"{3600 * CORES / mean:,.0f} an hour on {CORES} cores"
            )
