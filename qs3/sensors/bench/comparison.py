"""Real Kinect clouds and simulated ones, measured alike."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import MissingDataError
from qs3.sensors.bench import real
from qs3.sensors.bench.figures import draw_real
from qs3.sensors.bench.runner import fingerprint, read_cached
from qs3.sensors.bench.subject import Subject
from qs3.sensors.bench.tabletop import Tabletop
from qs3.sensors.renderers.base import Renderer
from qs3.utils.files import write_json

log = logging.getLogger(__name__)

FIGURE = "real.png"


@dataclass(frozen=True)
class Comparison:
    """Statistics of each cloud (qs3.sensors.bench.real), by name.

    Attributes:
        sensor: name of the simulated one.
        real, simulated: one dict a cloud.
        figure: file name.
    """

    sensor: str
    real: list[dict[str, Any]]
    simulated: list[dict[str, Any]]
    figure: str = FIGURE

    @staticmethod
    def spread(found: list[dict[str, Any]], key: str) -> tuple[float, float, float]:
        """Lowest, median and highest of one statistic."""
        values = np.array([d[key] for d in found], dtype=np.float64)
        values = values[np.isfinite(values)]
        if not values.size:
            return (float("nan"),) * 3
        return float(values.min()), float(np.median(values)), float(values.max())


def real_clouds(folder: Path) -> list[Path]:
    """The files, by name.

    Raises:
        MissingDataError: they are not here.
    """
    found = sorted(folder.glob("*.pcd"))
    if not found:
        raise MissingDataError(
            f"no .pcd files in real={folder}; without real= the bench makes no such comparison"
        )
    return found


def compare(
    subject: Subject,
    config: dict[str, Any],
    renderer: Renderer,
    cache: Path,
    figure: Path | None,
    folder: Path,
    scenes: int = 8,
    advance: Callable[[], None] = lambda: None,
) -> Comparison:
    """Measure all real clouds and as many simulated ones.

    Args:
        subject, config: the simulated sensor.
        renderer: makes its images.
        cache: as in `runner.run`.
        figure: where the picture goes; None draws none.
        folder: of the real clouds.
        scenes: how many are simulated.
        advance: called after each simulated scene.
    """
    real_images = [real.read_cloud(path) for path in real_clouds(folder)]
    table = Tabletop()
    key = fingerprint(config, renderer.provenance(), repr(table), scenes)
    path = cache / subject.name / f"tabletop-{key[:12]}.json"
    images = path.with_suffix(".npz")
    found = read_cached(path)
    if found is None or not images.is_file():
        depths = []
        for seed in range(scenes):
            depths.append(table.scan(subject, renderer, seed))
            advance()
        images.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(images, depth_m=np.stack(depths))
        write_json(path, {"scenes": scenes})
    with np.load(images) as file:
        simulated = list(file["depth_m"])
    statistics = [[real.statistics(d) for d in group] for group in (real_images, simulated)]
    if figure is not None:
        runs = [np.concatenate([s.runs_px for s in group]) for group in statistics]
        draw_real(real_images[0], simulated[0], (runs[0], runs[1]), figure)
    as_dicts = [[s.as_dict() for s in group] for group in statistics]
    return Comparison(subject.name, as_dicts[0], as_dicts[1])
