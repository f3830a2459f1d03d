"""Small nets of many sources, from which `.ci/trust_cases.py` makes the cases of the calibration.

    python .ci/trust_nets.py data=data out=out/trust model=narrow seeds=0,1,2
    python .ci/trust_nets.py data=data out=out/trust model=dgcnn seeds=0 sources=M

`data` holds modelnet10, specklenet10, specklenet10_view, specklenet10_kinect and roomscan10 as
`python generate.py domain=NAME splits=[train]` makes them. A net sees 128 points, is trained in
batches of 16 as `experiment=real_factor` trains (Adam, cosine, crop 0.3), and is saved as a
`result.pt` with the labelled clouds' statistics; one that is there is not trained again.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from qs3.data.store import open_pointset
from qs3.datamodules.augment import Augment
from qs3.datamodules.clouds import Clouds
from qs3.datamodules.splits import Labelled, load_clouds
from qs3.datamodules.validation_split import lineage
from qs3.models.dgcnn import dgcnn
from qs3.utils.files import atomic_path
from qs3.utils.seeding import derive

POINTS, BATCH, RATE, DECAY = 128, 16, 1e-3, 5e-5
STEPS = {"dgcnn": 300, "narrow": 500}


def narrow(num_classes: int) -> nn.Module:
    """PointNet without transforms, 64-128-256 wide: a training takes seconds."""
    return nn.Sequential(
        *(_Points(3, 64), _Points(64, 128), _Points(128, 256), _Largest()),
        *(nn.Linear(256, 128), nn.BatchNorm1d(128), nn.ReLU(), nn.Dropout(0.3)),
        nn.Linear(128, num_classes),
    )


class _Points(nn.Module):
    def __init__(self, given: int, made: int) -> None:
        super().__init__()
        self.linear, self.norm = nn.Linear(given, made), nn.BatchNorm1d(made)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.norm(self.linear(x.flatten(0, 1)))  # [B * N, C]
        return y.relu_().view(*x.shape[:2], -1)


class _Largest(nn.Module):
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.amax(dim=1)


MODELS = {"dgcnn": dgcnn, "narrow": narrow}
SOURCES = {
    "M": ("modelnet10", "points", "unit_ball"),
    "S": ("specklenet10", "points", "unit_ball"),
    "S_c": ("specklenet10", "points_clean", "unit_ball"),
    "S_1": ("specklenet10_view", "points", "unit_ball"),
    "S_K": ("specklenet10_kinect", "points", "unit_ball"),
    "R": ("roomscan10", "points", "unit_ball"),
    "R_m": ("roomscan10", "points", "above_floor"),
}
"""By name the store, its variant, and the scale of the clouds; R_m knows sizes and heights."""


def labelled(data: Path, name: str) -> Labelled:
    """The source's labelled clouds, in one sample each."""
    store, variant, scale = SOURCES[name]
    points = replace(open_pointset(data / store, variant, verify=False), floor_m=0.0)
    clouds = load_clouds(points, "train", POINTS, cache_dir=data / ".cache", scale=scale)
    labels = torch.from_numpy(np.array(points.labels[points.indices("train")]))
    return Labelled(clouds.clouds, clouds.ids, labels)


def parts(source: Labelled) -> tuple[Labelled, Labelled]:
    """What trains, and what is held out: the rule of `data.val=lineage`."""
    train, held_out = lineage(source.ids, source.labels.numpy())
    return source.at(train), source.at(held_out)


def train(model: str, source: Labelled, seed: int, scale: str) -> torch.nn.Module:
    """A net after its steps."""
    torch.manual_seed(seed)
    net = MODELS[model](num_classes=10)
    lift = 0.2 if scale == "above_floor" else 0.0
    augment, generator = Augment(crop=0.3, lift=lift), torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(net.parameters(), lr=RATE, weight_decay=DECAY)
    cosine = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS[model])
    order: list[int] = []
    clouds: Clouds = source.clouds
    for _ in range(STEPS[model]):
        if len(order) < BATCH:
            order = torch.randperm(len(source.ids), generator=generator).tolist()
        index, order = torch.tensor(order[:BATCH]), order[BATCH:]
        points = augment(clouds.take(index), generator, scale)
        loss = torch.nn.functional.cross_entropy(net(points), source.labels[index])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        cosine.step()
    return net.eval()


def main(given: dict[str, Any]) -> None:
    """Train what is missing."""
    torch.set_num_threads(1)
    data, out, model = Path(given["data"]), Path(given["out"]), given.get("model", "pointnet")
    out.mkdir(parents=True, exist_ok=True)
    for seed in map(int, given.get("seeds", "0").split(",")):
        for name in given.get("sources", ",".join(SOURCES)).split(","):
            scale = SOURCES[name][2]
            path = out / f"{model}-{name}-{seed}.pt"
            if path.is_file():
                continue
            began = time.monotonic()
            trained, _ = parts(labelled(data, name))
            net = train(model, trained, derive(seed, "trust", name) % 2**31, scale)
            with atomic_path(path) as half:
                torch.save(net.state_dict(), half)
            print(f"{path}: {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(dict(word.split("=", 1) for word in sys.argv[1:]))
