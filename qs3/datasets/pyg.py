"""Datasets of ours as datasets of PyTorch Geometric, and theirs as ours.

    from qs3.datasets.pyg import from_pyg, knn_graph, to_pyg

    train = to_pyg("specklenet10", "train", transform=FixedPoints(1024))  # a domain of conf/domain
    loader = DataLoader(train, batch_size=32, shuffle=True)               # PyG's own
    from_pyg({"train": mine, "test": my_test}, "data/mine", classes=["box", "cup"])

PyG is imported here and nowhere else in qs3.datasets: import this module when you want it. Its own
neighbour searches need torch-cluster or pyg-lib; `knn_graph` makes their edges from ours.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch_geometric.data import Data, Dataset, InMemoryDataset

from qs3.classes import class_list
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError, DataError
from qs3.geometry.neighbours import knn
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.store.meta import MadeOf, ManifestRow, is_begun, is_finished
from qs3.store.store import PointSet, write_pointset


class Clouds(InMemoryDataset):
    """Clouds as PyG has them: `Data(pos=[P, 3] float32, y=[1] int64, id=str)`, in our order.

    Without labels there is no `y`, else a position in the tuple of names `classes`.
    """

    def __init__(self, clouds: PointSet, transform: Callable[[Data], Data] | None = None) -> None:
        super().__init__(None, transform)
        self.classes, self.name = clouds.classes, clouds.name
        points = torch.from_numpy(np.array(clouds.points, dtype=np.float32))
        items = []
        for cloud, label, name in zip(points, clouds.labels.tolist(), clouds.ids, strict=True):
            label_of = {"y": torch.tensor([label])} if clouds.labelled else {}
            items.append(Data(pos=cloud, id=name, **label_of))
        self.data, self.slices = self.collate(items)

    @property
    def num_classes(self) -> int:
        """Also of classes that do not occur."""
        return len(self.classes)


def to_pyg(
    source: PointSet | Domain | str,
    split: str | None = None,
    transform: Callable[[Data], Data] | None = None,
) -> Clouds:
    """A dataset of ours, in memory, for PyG's loaders, transforms and nets.

    `source` is an open dataset, a domain, or the name of a domain in conf/domain; without a split
    all its clouds. The transform is applied whenever a cloud is taken.
    """
    if isinstance(source, str):
        source = compose_domain(source, {})
    clouds = source.open() if isinstance(source, Domain) else source
    return Clouds(clouds.split(split) if split else clouds, transform)


def from_pyg(
    datasets: Mapping[str, Dataset | Sequence[Data]],
    folder: str | Path,
    *,
    classes: str | Sequence[str] | None = None,
    points: int | None = None,
) -> PointSet:
    """Write datasets of PyG as one of ours, which a domain can name by its `path`.

    Their transforms are applied once. z should be up (`Domain.gravity`). Points are kept bit by bit
    where they are float32 and not thinned.

    Args:
        datasets: by split ("train", "validation", "test"). Each cloud has `pos` [n, 3], and all or
            none of them a `y` of one whole number. Its `id` names it, if it is text; else its class
            and position.
        folder: of the new dataset.
        classes: names in the order of `y`, or "modelnet40"; None: `classes` of the first dataset,
            if it has any; without labels the benchmark's ten.
        points: of a cloud; larger ones are thinned to their farthest points, from the first on.
            None: all clouds must have the same number.
    """
    folder = Path(folder)
    if is_finished(folder) or is_begun(folder):
        raise ConfigError(f"{folder} holds something already; delete it or choose another folder")
    taken = [
        (split, number, dataset[number])
        for split, dataset in datasets.items()
        for number in range(len(dataset))  # PyG's way of iterating needs an IndexError to end
    ]
    labels = [_label(one, f"cloud {number} of {split!r}") for split, number, one in taken]
    names = _classes(classes, next(iter(datasets.values())), labels)
    clouds, rows = [], []
    for (split, number, one), y in zip(taken, labels, strict=True):
        pos = one.pos.detach().cpu().numpy().astype(np.float32)
        points = len(pos) if points is None else points
        clouds.append(pos[farthest_point_sampling_np(pos, points)] if len(pos) > points else pos)
        cls, key = "" if y is None else names[y], getattr(one, "id", None)
        if not key or not isinstance(key, str):
            key = f"{cls or 'cloud'}/{split}/{number:06d}"
        rows.append(ManifestRow(id=key, cls=cls, split=split, valid_points=len(pos)))
    return write_pointset(
        folder,
        name=folder.name,
        classes=names,
        arrays={"points": clouds},
        rows=rows,
        meta=MadeOf(objects="a dataset of torch_geometric").meta,
    )


def _label(cloud: Data, where: str) -> int | None:
    """The class of a cloud, if it has one."""
    if getattr(cloud, "face", None) is not None:
        raise DataError(f"{where} is a mesh: give the dataset transform=SamplePoints(n)")
    y = getattr(cloud, "y", None)
    if y is not None and int(y) != y:
        raise DataError(f"{where}: y is {y}, expected one whole number, the class")
    return None if y is None else int(y)


def _classes(
    given: str | Sequence[str] | None, dataset: object, labels: list[int | None]
) -> list[str]:
    known = [label for label in labels if label is not None]
    names = given if given is not None else getattr(dataset, "classes", None)
    found = [] if names is None and known else list(class_list(names))
    if len(set(found)) < len(found) or (known and not 0 <= min(known) <= max(known) < len(found)):
        raise ConfigError(
            f"classes={found}: expected a name for each y, {min(known)} to {max(known)}"
        )
    return found


def knn_graph(x: Tensor, batch: Tensor | None, k: int, *, loop: bool = False) -> Tensor:
    """Edges from the k nearest neighbours of each point to it, as PyG's `knn_graph` has them.

    Clouds of one size take one search a batch; others one a cloud.

    Args:
        x: [n, c] positions or features of all clouds of a batch, on any device.
        batch: [n] int64, sorted: which cloud each point belongs to; None: one cloud.
        k: neighbours of a point; a cloud of fewer has edges to all that there are.
        loop: whether a point is a neighbour of itself.

    Returns:
        [2, edges] int64: neighbours (sources) in the first row, points (targets) in the second,
        points in order, and the neighbours of each from the nearest on.
    """
    if batch is None:
        batch = x.new_zeros(len(x), dtype=torch.int64)
    elif (batch.diff() < 0).any():
        raise ValueError("batch is not sorted: the points of each cloud must be together")
    sizes = batch.unique_consecutive(return_counts=True)[1].tolist()
    starts = np.cumsum([0, *sizes]).tolist()
    clouds = [x.view(len(sizes), sizes[0], -1)] if len(set(sizes)) == 1 else x[None].split(sizes, 1)
    parts = [_edges(cloud, k, loop) + start for start, cloud in zip(starts, clouds, strict=False)]
    return torch.cat([x.new_empty((2, 0), dtype=torch.int64), *parts], dim=1)


def _edges(x: Tensor, k: int, loop: bool) -> Tensor:
    """[2, edges] of clouds of one size, [b, n, c]."""
    b, n, _ = x.shape
    own = torch.arange(n, device=x.device)[None, :, None]
    index = knn(x, min(k + (not loop), n))
    if not loop:  # of copies of a point, another one may be found first, and itself not at all
        other = index != own
        other[..., -1] &= ~other.all(-1)
        index = index[other].view(b, n, -1)
    index = index + (torch.arange(b, device=x.device) * n)[:, None, None]
    target = torch.arange(b * n, device=x.device).view(b, n, 1).expand_as(index)
    return torch.stack([index.flatten(), target.flatten()])
