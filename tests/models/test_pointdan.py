import torch

from qs3.models.pointdan import NodeModule, pointdan


def test_node_module_against_loops() -> None:
    """As the paper has it, cloud by cloud, node by node."""
    torch.manual_seed(0)
    module = NodeModule(channels=5, nodes=6, neighbours=4, radius=0.5).double().eval()
    x = torch.rand(2, 20, 3, dtype=torch.float64)
    f = torch.randn(2, 20, 5, dtype=torch.float64)
    found = module(x, f)
    mapped = module.residual(f)
    for cloud in range(2):
        taken = [0]
        while len(taken) < 6:
            nearest = torch.cdist(x[cloud], x[cloud][taken]).amin(1)
            taken.append(int(nearest.argmax()))
        places, features = [], []
        for node in taken:
            inside = [i for i in range(20) if (x[cloud, i] - x[cloud, node]).norm() < 0.5][:4]
            inside += [inside[0]] * (4 - len(inside))
            moves = [
                torch.tanh(module.offset.weight @ (f[cloud, i] - f[cloud, node]))
                * (x[cloud, i] - x[cloud, node])
                for i in inside
            ]
            place = x[cloud, node] + torch.stack(moves).mean(0)
            near = (x[cloud] - place).norm(dim=1).argsort()[:4]
            places.append(place)
            features.append(mapped[cloud][near].amax(0))
        torch.testing.assert_close(found.places[cloud], torch.stack(places))
        torch.testing.assert_close(found.features[cloud], torch.stack(features))
        for i in range(20):
            distance = (torch.stack(places) - x[cloud, i]).square().sum(1)
            three = distance.argsort()[:3]
            weight = 1 / distance[three].clamp_min(1e-10)
            back = (weight[:, None] / weight.sum() * torch.stack(features)[three]).sum(0)
            torch.testing.assert_close(found.points[cloud, i], torch.cat([f[cloud, i], back]))


def test_sizes() -> None:
    torch.manual_seed(0)
    net = pointdan(10)
    points = torch.rand(2, 100, 3) * 2 - 1
    assert net(points).shape == (2, 10)
    features, nodes = net.backbone.with_nodes(points)
    assert features.global_.shape == (2, 1024)
    assert features.per_point is not None
    assert features.per_point.shape == (2, 100, 128)
    assert nodes.features.shape == (2, 64, 64)
    counts = {name: sum(p.numel() for p in m.parameters()) for name, m in net.named_children()}
    # Two T-Nets, four convolutions, nodes; each with its batch norm. Two linear heads.
    transforms = _t_net(3) + _t_net(64)
    convolutions = _conv(3, 64) + _conv(64, 64) + _conv(128, 128) + _conv(128, 1024)
    assert counts["backbone"] == transforms + convolutions + _conv(64, 64) + 3 * 64 + 2048
    assert counts["head"] == 2 * (1024 * 10 + 10)


def _conv(wide: int, narrow: int) -> int:
    return wide * narrow + 3 * narrow  # weights, bias, scale and shift


def _t_net(k: int) -> int:
    points = _conv(k, 64) + _conv(64, 128) + _conv(128, 1024)
    return points + _conv(1024, 512) + _conv(512, 256) + 256 * k * k + k * k


def test_logits_are_the_mean_of_both_heads() -> None:
    net = pointdan(3, nodes=4, neighbours=4).eval()
    points = torch.rand(2, 30, 3)
    features = net.features(points).global_
    torch.testing.assert_close(
        net(points), (net.head.first(features) + net.head.second(features)) / 2
    )


def test_order_of_points_does_not_matter_but_for_the_first() -> None:
    """In eval the first node is the first point; the order of the rest is free."""
    torch.manual_seed(0)
    net = pointdan(3, nodes=8, neighbours=64, radius=9.0).eval()  # balls that hold all points
    points = torch.rand(2, 40, 3)
    order = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(39)])
    torch.testing.assert_close(net(points), net(points[:, order]), rtol=1e-4, atol=1e-5)
