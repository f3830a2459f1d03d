import pytest
import torch
from torch import nn

from qs3.errors import ConfigError
from qs3.methods.defrec import DefRec, ReconstructionHead, deform, masked_chamfer
from qs3.models.base import Features
from tests.methods.shapes import tiny_net


def _batch() -> dict:
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(4, 64, 3, generator=generator) * 2 - 1
    return {
        "source": {"points": clouds, "y_source": torch.tensor([0, 1, 2, 3])},
        "target": {"points": clouds.flip(0)},
    }


def test_head_is_the_layer_on_concatenated_features() -> None:
    head = ReconstructionHead(tiny_net(), dropout=0.5).eval()
    features = Features(torch.randn(3, 64), torch.randn(3, 10, 32))
    assert features.per_point is not None
    both = torch.cat([features.per_point, features.global_[:, None].expand(-1, 10, -1)], dim=2)
    first = nn.Linear(96, 256, bias=False)
    first.weight = nn.Parameter(torch.cat([head.of_point, head.of_cloud], dim=1))
    expected = head.rest(first(both).flatten(0, 1)).view(3, 10, 3)
    torch.testing.assert_close(head(features), expected)
    widths = [m.out_features for m in head.rest if isinstance(m, nn.Linear)]
    assert widths == [256, 128, 3]


def test_terms_and_weights() -> None:
    net, batch = tiny_net(), _batch()
    values = {}
    for w in (0.5, 0.2):
        method = DefRec(defrec_weight=w, min_points=2, dropout=0.0, on_source=True)
        torch.manual_seed(0)
        method.prepare(net)
        values[w] = method.loss(net, batch, torch.Generator().manual_seed(0))
        assert set(values[w]) == {"ce", "defrec", "defrec_source"}
    assert values[0.5]["ce"].item() / values[0.2]["ce"].item() == pytest.approx(0.5 / 0.8)
    for term in ("defrec", "defrec_source"):
        ratio = values[0.5][term].item() / values[0.2][term].item()
        assert ratio == pytest.approx(0.5 / 0.2)


def test_the_loss_is_of_the_deformed_points_alone() -> None:
    """What the head says about the others, and where they are, changes nothing."""
    method, net, batch = DefRec(min_points=2, dropout=0.0), tiny_net(), _batch()
    method.prepare(net)
    found = deform(batch["target"]["points"], torch.Generator().manual_seed(0), 2)
    value = method.loss(net, batch, torch.Generator().manual_seed(0))["defrec"]
    assert method.head is not None
    predicted = method.head(net.features(found.points))
    wrong = torch.where(found.mask[:, :, None], predicted, 1e3)
    target = torch.where(found.mask[:, :, None], batch["target"]["points"], -1e3)
    expected = 0.5 * 20 * masked_chamfer(wrong, target, found.mask, found.mask).mean()
    torch.testing.assert_close(value, expected)


def test_no_voxel_to_deform_is_no_loss_and_no_nan() -> None:
    method, net = DefRec(min_points=1025), tiny_net()
    method.prepare(net)
    terms = method.loss(net, _batch(), torch.Generator().manual_seed(0))
    assert terms["defrec"].item() == 0.0
    torch.stack(list(terms.values())).sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_a_model_without_features_per_point_is_refused() -> None:
    net = tiny_net()
    per_cloud = net.backbone.forward
    net.backbone.forward = lambda points: Features(per_cloud(points).global_, None)
    with pytest.raises(ConfigError, match="features of points"):
        DefRec().prepare(net)
