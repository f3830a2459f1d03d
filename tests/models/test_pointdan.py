import torch

from qs3.models.pointdan import NodeModule


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
