"""A toy problem that trains in seconds: four shapes, two domains, a net of 7,000 weights.

For the notebooks and for trying things out. Its numbers say nothing about scans.

    write_toy("toy")
    train(*toy_overrides("toy"), "seed=1")  # qs3.api
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.config.compose import override
from qs3.store.meta import MadeOf, ManifestRow
from qs3.store.store import PointSet, write_pointset

SHAPES = {
    "ball": (1.0, 1.0, 1.0),
    "rod": (0.25, 0.25, 1.0),
    "slab": (1.0, 1.0, 0.2),
    "plank": (1.0, 0.35, 0.15),
}
"""Half axes of the ellipsoid that each class is."""

POINTS = 64
Counts = tuple[int, ...]
_TRAIN, _TEST = (120, 30, 60, 30), (80, 20, 40, 20)  # of the target, by class
_NOISE = {"toy_source": 0.02, "toy_target": 0.12}  # of each coordinate, by domain


class ToyNet(nn.Module):
    """[B, N, 3] to logits [B, C]: a layer or two for each point, a maximum, two for the cloud."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.points = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
        self.cloud = nn.Sequential(
            nn.BatchNorm1d(64), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, num_classes)
        )

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits."""
        features: torch.Tensor = self.cloud(self.points(points).amax(dim=1))  # [B, 64] inside
        return features


def write_toy(root: str | Path, seed: int = 0) -> tuple[PointSet, PointSet]:
    """Write a source with hardly any noise, and a noisy target of unequally frequent classes."""
    source = _write(Path(root), "toy_source", (30,) * 4, (10,) * 4, seed)
    return source, _write(Path(root), "toy_target", _TRAIN, _TEST, seed + 1)


def toy_overrides(root: str | Path) -> list[str]:
    """What makes a run of train.py one on the toy, in `root`: QBST with three short rounds."""
    root = Path(root).absolute()
    domains = []
    for role in ("source", "target"):
        own = f"name=toy_{role} title=toy_{role} symbol={role[0].upper()} published=null"
        own += f" simulated=true classes=[{','.join(SHAPES)}]"
        domains += [f"domain@data.{role}=own", *(f"data.{role}.{word}" for word in own.split())]
        domains.append(override(f"data.{role}.path", root / "data" / f"toy_{role}"))
    return [
        *("experiment=quickstart", "experiment_name=toy", "method=source_only", "num_classes=4"),
        *domains,
        "model=pointnet",
        "model._target_=qs3.tools.toy.ToyNet",
        *(f"~model.{key}" for key in ("variant", "norm", "dropout")),
        f"data.points={POINTS}",
        *("data.fps_starts=1", "protocol.epochs=12", "protocol.optimizer.lr=0.01"),
        *("selftraining.rounds=3", "selftraining.epochs=10", "selftraining.theta=0.7"),
        *("selftraining.epsilon=0.05", "trainer.threads=1", "logger=csv", "report.pictures=false"),
        override("paths.data_dir", root / "data"),
        override("paths.log_dir", root / "logs"),
        override("paths.warmup_dir", root / "warmups"),
    ]


def _write(root: Path, name: str, train: Counts, test: Counts, seed: int) -> PointSet:
    rng, clouds, rows = np.random.default_rng(seed), [], []
    for split, counts in (("train", train), ("test", test)):
        for (cls, half_axes), count in zip(SHAPES.items(), counts, strict=True):
            for i in range(count):
                cloud = rng.normal(size=(POINTS, 3))
                cloud *= half_axes / np.linalg.norm(cloud, axis=1, keepdims=True)
                clouds.append(cloud + _NOISE[name] * rng.normal(size=cloud.shape))
                rows.append(ManifestRow(f"{cls}/{split}/{cls}_{i:04d}", cls, split))
    return write_pointset(
        root / "data" / name,
        name=name,
        classes=tuple(SHAPES),
        arrays={"points": np.array(clouds, dtype=np.float32)},
        rows=rows,
        meta=MadeOf(objects="toy shapes").meta,
    )
