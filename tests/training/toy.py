"""A problem that trains in seconds: three shapes, a shifted target, and a net of 300 weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor, nn

from qs3.store.meta import MadeOf, ManifestRow
from qs3.store.store import write_pointset
from tests.composing import compose

CLASSES = ("ball", "rod", "slab")
_SHAPES = {"ball": (1.0, 1.0, 1.0), "rod": (0.2, 0.2, 1.0), "slab": (1.0, 1.0, 0.15)}
MADE_OF = {
    "specklenet10": MadeOf(
        objects="embedded catalogue", sensor="speckle_stereo", views=5, meshes="0123456789ab"
    ),
    "kinectsim10": MadeOf(
        objects="embedded catalogue", sensor="kinect_like", views=4, benchmark="kinectsim10 v2"
    ),
}
CONF = Path(__file__).parents[2] / "conf"


class TinyNet(nn.Module):
    """[B, N, 3] to logits [B, C], with batch norm and dropout like the real nets."""

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.lift = nn.Linear(3, 16)
        self.norm = nn.BatchNorm1d(16, momentum=0.5)
        self.drop = nn.Dropout(0.3)
        self.head = nn.Linear(16, num_classes)

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        x = torch.relu(self.lift(points)).amax(dim=1)  # [B, 16]
        return self.head(self.drop(self.norm(x)))


def write_domain(
    folder: Path,
    name: str,
    *,
    noise: float,
    train: int | tuple[int, ...] = 24,
    test: int = 8,
    points: int = 64,
) -> None:
    """A store of `train` and `test` clouds a class, or of each class."""
    rng = np.random.default_rng(len(name))
    clouds, rows = [], []
    for split, count in (("train", train), ("test", test)):
        each = count if isinstance(count, tuple) else (count,) * len(CLASSES)
        for cls, n in zip(CLASSES, each, strict=True):
            for i in range(n):
                cloud = rng.normal(size=(points, 3)) * _SHAPES[cls]
                clouds.append(cloud + noise * rng.normal(size=(points, 3)))
                rows.append(ManifestRow(id=f"{cls}/{split}/{i:03d}", cls=cls, split=split))
    write_pointset(
        folder / name,
        name=name,
        classes=CLASSES,
        arrays={"points": np.array(clouds, dtype=np.float32)},
        rows=rows,
        meta=MADE_OF.get(name, MadeOf()).meta,
    )


def write_toy(folder: Path) -> None:
    """Source `toy_source` and target `toy_target` under `folder`."""
    write_domain(folder, "specklenet10", noise=0.05)
    write_domain(folder, "kinectsim10", noise=0.15)


def overrides(root: Path, *more: str) -> list[str]:
    """What turns conf/experiment/quickstart.yaml into a toy run in `root`."""
    rounds = ["rounds=2", "epochs=2", "steps=null", "batch_size=8"]
    if not any(word.startswith("selftraining.share=0") for word in more):  # which sets it
        rounds.append("theta=0.4")
    return [
        "experiment=quickstart",
        f"paths.data_dir={root / 'data'}",
        f"paths.log_dir={root / 'logs'}",
        "num_classes=3",
        "model._target_=tests.training.toy.TinyNet",
        *(f"~model.{key}" for key in ("k", "variant", "norm", "dropout")),
        "data.points=32",
        "protocol.epochs=3",
        "protocol.steps=null",
        "protocol.optimizer.lr=0.02",
        *(f"selftraining.{x}" for x in rounds if "selftraining=none" not in more),
        "trainer.threads=1",
        "logger=csv",
        "report.pictures=false",
        *more,
    ]


def toy_config(root: Path, *more: str) -> DictConfig:
    """The composed config of a toy run."""
    return compose("train", overrides(root, *more))
