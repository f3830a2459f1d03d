import torch
from torch.nn import functional as F

from qs3.models.committee import committee
from qs3.models.dgcnn import dgcnn
from qs3.models.frontview import frontview


def _alone(net: torch.nn.Module) -> list[torch.nn.Module]:
    """Nets of the same weights that know of no committee."""
    alone = [dgcnn(4), frontview(4)]
    for k, one in enumerate(alone):
        one.backbone.load_state_dict(net.backbone.each[k].state_dict())
        one.head.load_state_dict(net.head.each[k].state_dict())
    return alone


def test_members_learn_apart_and_answer_together() -> None:
    torch.manual_seed(0)
    net, points = committee(4), torch.rand(8, 40, 3)
    first, second = _alone(net)
    torch.manual_seed(1)  # of dropout
    expected = torch.cat([first.train()(points[:4]), second.train()(points[4:])])
    torch.manual_seed(1)
    torch.testing.assert_close(net.train()(points), expected)
    labels = torch.arange(8) % 4
    F.cross_entropy(net(points), labels).backward()
    assert all(p.grad is not None for p in net.parameters())
    net.eval()
    probabilities = torch.stack([one.eval()(points).softmax(1) for one in _alone(net)])
    torch.testing.assert_close(net(points).exp(), probabilities.mean(0))
