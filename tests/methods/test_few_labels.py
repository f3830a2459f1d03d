import torch
from torch.nn import functional as F

from qs3.methods.bounds import FewLabels


def test_the_loss_is_of_both_domains() -> None:
    points = torch.randn(2, 6, 5, 3, generator=torch.Generator().manual_seed(0))
    labels = torch.tensor([[0, 1, 2, 0, 1, 2], [2, 2, 1, 1, 0, 0]])
    net = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(15, 3))
    batch = {
        "source": {"points": points[0], "y_target_train": labels[0]},
        "beside": {"points": points[1], "y_source": labels[1]},
    }
    terms = FewLabels().loss(net, batch, torch.Generator())
    expected = [F.cross_entropy(net(p), y) for p, y in zip(points, labels, strict=True)]
    torch.testing.assert_close([terms["ce"], terms["source"]], expected)
