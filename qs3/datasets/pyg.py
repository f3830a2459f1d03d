"""Datasets of ours as datasets of PyTorch Geometric, and theirs as ours.

    from qs3.datasets.pyg import from_pyg, to_pyg

    train = to_pyg("specklenet10", "train", transform=FixedPoints(1024))  # a domain of conf/domain
    loader = DataLoader(train, batch_size=32, shuffle=True)               # PyG's own
    from_pyg({"train": mine, "test": my_test}, "data/mine", classes=["box", "cup"])

PyG is imported here and nowhere else in qs3.datasets: import this module when you want it.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch_geometric.data import Data, Dataset, InMemoryDataset

from qs3.classes import class_list
from qs3.datasets.domain import Domain, compose_domain
from qs3.errors import ConfigError, DataError
from qs3.geometry.sampling import farthest_point_sampling_np
from qs3.store.meta import MadeOf, ManifestRow, is_begun, is_finished
from qs3.store.store import PointSet, write_pointset


class Clouds(InMemoryDataset):
    """Clouds as PyG has them: `Data(pos=[P, 3] float32, y=[1] int64, id=str)`, in our order.

    Without labels `y` is missing, else a position in the tuple of names `classes`.
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
        most = len(pos) if points is None else points
        clouds.append(pos[farthest_point_sampling_np(pos, most)] if len(pos) > most else pos)
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
        raise ConfigError(f"classes={found}: expected a name for each y, of {sorted({*known})}")
    return found
