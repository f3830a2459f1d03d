"""Datasets of ours in PyTorch Geometric's hands, and theirs in ours."""

import pickle

import numpy as np
import pytest
import torch
from torch_geometric.data import Data, InMemoryDataset
from torch_geometric.loader import DataLoader
from torch_geometric.transforms import NormalizeScale, SamplePoints

from qs3.datasets.domain import Domain
from qs3.datasets.pyg import from_pyg, to_pyg
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.store.meta import ManifestRow
from qs3.store.store import write_pointset

CLASSES = ("box", "cup", "pen")
RNG = np.random.default_rng(0)


@pytest.fixture
def ours(tmp_path):
    """Twelve clouds of 64 points, nine of them for training."""
    rows = [
        ManifestRow(f"{CLASSES[i % 3]}/{split}/{i:04d}", CLASSES[i % 3], split)
        for i, split in enumerate(["train"] * 9 + ["test"] * 3)
    ]
    points = RNG.normal(size=(12, 64, 3)).astype(np.float32)
    points[0, 0] = [-0.0, 1e-42, 3.4e38]  # bits that a calculation would not keep
    return write_pointset(
        tmp_path / "ours",
        name="ours",
        classes=CLASSES,
        arrays={"points": points},
        rows=rows,
        meta={},
    )


def domain(folder, classes=CLASSES):
    return Domain("mine", "X", "mine", folder, classes=classes)


def test_a_split_as_pyg_has_it(ours):
    data = to_pyg(ours, "train")
    assert isinstance(data, InMemoryDataset)
    assert len(data) == 9
    assert (data.num_classes, data.classes, data.name) == (3, CLASSES, "ours")
    for i, item in enumerate(data):
        assert item.pos.dtype == torch.float32
        assert item.y.dtype == torch.int64
        assert item.y.tolist() == [ours.labels[i]]
        assert item.id == ours.ids[i]
        assert item.pos.numpy().tobytes() == np.asarray(ours.points[i]).tobytes()
    assert len(data[:4]) == 4
    batch = next(iter(DataLoader(to_pyg(ours, transform=NormalizeScale()), batch_size=12)))
    assert batch.pos.shape == (12 * 64, 3)
    assert batch.pos[64:].abs().max() <= 1  # the first cloud's numbers are too odd
    assert tuple(batch.id) == ours.ids
    assert pickle.loads(pickle.dumps(data))[5].id == data[5].id
    with pytest.raises(DataError):
        to_pyg(ours, "validation")


def test_ours_to_pyg_and_back_bit_for_bit(ours, tmp_path):
    folder = tmp_path / "back"
    both = {split: to_pyg(domain(tmp_path / "ours"), split) for split in ("train", "test")}
    back = from_pyg(both, folder)
    assert np.asarray(back.points).tobytes() == np.asarray(ours.points).tobytes()
    np.testing.assert_array_equal(back.labels, ours.labels)
    np.testing.assert_array_equal(back.splits, ours.splits)
    assert (back.ids, back.classes) == (ours.ids, CLASSES)
    assert back.sha256 == ours.sha256
    again = domain(folder).open()  # as a run does
    assert again.sha256 == ours.sha256
    with pytest.raises(ConfigError):
        from_pyg(both, folder)


class Pyramids(InMemoryDataset):
    """A user's own: meshes, in memory."""

    def __init__(self, count=6, transform=None):
        super().__init__(None, transform)
        corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
        face = torch.tensor([[0, 0, 0, 1], [1, 2, 3, 2], [2, 3, 1, 3]])
        items = [
            Data(pos=corners * (i + 1), face=face, y=torch.tensor([i % 2])) for i in range(count)
        ]
        self.data, self.slices = self.collate(items)


def test_a_users_dataset_becomes_a_domain(tmp_path):
    torch.manual_seed(0)
    with pytest.raises(DataError):
        from_pyg({"train": Pyramids()}, tmp_path / "mine", classes=["even", "odd"])
    sampled = Pyramids(transform=SamplePoints(128))
    data = from_pyg({"train": sampled}, tmp_path / "mine", classes=["even", "odd"])
    assert data.points.shape == (6, 128, 3)
    assert data.labels.tolist() == [0, 1] * 3
    assert data.ids[1] == "odd/train/000001"
    assert np.abs(np.asarray(data.points[5])).max() > 4  # the sixth is six times as large
    assert domain(tmp_path / "mine", ["even", "odd"]).open().sha256 == data.sha256


def clouds(*sizes, **more):
    return [Data(pos=torch.randn(n, 3, dtype=torch.float64), **more) for n in sizes]


def test_clouds_of_several_sizes_are_thinned_to_their_farthest_points(tmp_path):
    items = clouds(50, 80, 30)
    with pytest.raises(DataError):
        from_pyg({"test": items[:2]}, tmp_path / "a")  # the second is larger, and not thinned
    with pytest.raises(DataError):
        from_pyg({"test": items}, tmp_path / "a", points=31)
    data = from_pyg({"test": items}, tmp_path / "a", points=30)
    assert not data.labelled
    assert len(data.classes) == 10
    assert data.name == "a"
    for item, cloud in zip(items, np.asarray(data.points), strict=True):
        points = item.pos.numpy().astype(np.float32)
        chosen = [0]
        while len(chosen) < 30 < len(points):  # farthest points, the slow way
            gaps = np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(axis=1)
            chosen.append(int(gaps.argmax()))
        np.testing.assert_array_equal(cloud, points[chosen] if len(points) > 30 else points)


@pytest.mark.parametrize(
    "items",
    [
        [Data(pos=torch.zeros(4, 2))],
        [Data(pos=torch.full((4, 3), torch.nan))],
        [Data(pos=torch.zeros(4, 3), y=torch.tensor([0.5]))],
        [Data(pos=torch.zeros(4, 3), y=torch.tensor([3]))],
        [Data(pos=torch.zeros(4, 3), y=torch.tensor([-1]))],
        [Data(pos=torch.zeros(4, 3), y=torch.tensor([0])), Data(pos=torch.zeros(4, 3))],
        [Data(pos=torch.zeros(4, 3), y=torch.tensor([0]), id="a")] * 2,
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, items):
    with pytest.raises(Qs3Error):
        from_pyg({"train": items}, tmp_path / "a", classes=CLASSES)
    assert not (tmp_path / "a" / "meta.yaml").exists()
