from collections.abc import Iterator

import pytest
import torch
from torch.nn import functional as F

from qs3.models.base import PointClassifier
from qs3.models.dgcnn import dgcnn


def _small(k: int = 5, variant: str = "uda", norm: str = "batch") -> PointClassifier:
    torch.manual_seed(0)
    return dgcnn(4, k=k, variant=variant, norm=norm, dropout=0.0)


@pytest.fixture
def deterministic() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("deterministic")
@pytest.mark.parametrize("threads", [1, 2])
def test_same_bytes_every_time(threads: int) -> None:
    torch.set_num_threads(threads)
    points = torch.randn(4, 200, 3, generator=torch.Generator().manual_seed(0))

    def gradients() -> list[torch.Tensor]:
        model = _small(k=20)
        F.cross_entropy(model(points), torch.tensor([0, 1, 2, 3])).backward()
        return [p.grad for p in model.parameters()]

    first = gradients()
    assert all(torch.equal(a, b) for a, b in zip(first, gradients(), strict=True))
