"""Real Kinect clouds and simulated ones, measured alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.calibration.bench import real
from qs3.calibration.bench.figures import draw_real
from qs3.calibration.bench.runner import fingerprint, read_cached
from qs3.calibration.bench.subject import Subject
from qs3.calibration.bench.tabletop import Tabletop
from qs3.errors import MissingDataError
from qs3.sensors.renderers.base import Renderer
from qs3.utils.files import atomic_path, write_json

FIGURE = "real.png"


@dataclass(frozen=True)
class Comparison:
    """Statistics of each cloud (qs3.calibration.bench.real), by name.

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
    """The .pcd files in a folder, by name; MissingDataError if there are none."""
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
) -> Comparison:
    """Measure all real clouds and as many simulated ones.

    Args:
        subject, config: the simulated sensor.
        renderer: makes its images.
        cache: as in `runner.run`.
        figure: where the picture goes; None draws none.
        folder: of the real clouds.
        scenes: how many are simulated.
    """
    real_images = [real.read_cloud(path) for path in real_clouds(folder)]
    table = Tabletop()
    key = fingerprint(config, renderer.provenance(), repr(table), scenes)
    path = cache / subject.name / f"tabletop-{key[:12]}.json"
    kept = path.with_suffix(".npz")
    if read_cached(path) is None or not kept.is_file():
        depths = []
        for seed in range(scenes):
            depths.append(table.scan(subject, renderer, seed))
        with atomic_path(kept) as temporary:
            np.savez_compressed(temporary, depth_m=np.stack(depths))
        write_json(path, {"scenes": scenes})
    with np.load(kept) as file:
        simulated = list(file["depth_m"])
    images = (real_images, simulated)
    numbers = [[real.statistics(depth) for depth in group] for group in images]
    if figure is not None:
        runs = [np.concatenate([found[1] for found in group]) for group in numbers]
        draw_real(real_images[0], simulated[0], (runs[0], runs[1]), figure)
    found_real, found_simulated = ([found[0] for found in group] for group in numbers)
    return Comparison(subject.name, found_real, found_simulated)
