import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.defrec import (
    VOXELS,
    DefRec,
    cloud_size,
    deform,
    masked_chamfer,
    voxel_centre,
    voxel_of,
)
from qs3.methods.gast import Gast
from qs3.methods.mlsp import Mlsp
from tests.methods.shapes import tiny_net


def _batch() -> dict:
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(4, 64, 3, generator=generator) * 2 - 1
    return {
        "source": {"points": clouds, "y_source": torch.tensor([0, 1, 2, 3])},
        "target": {"points": clouds.flip(0)},
    }


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


def brute_force(a, b, mask_a, mask_b):
    """Loops over clouds and points."""
    result = []
    for cloud in range(len(a)):
        first, second = a[cloud][mask_a[cloud]], b[cloud][mask_b[cloud]]
        if len(first) == 0 or len(second) == 0:
            result.append(a.new_zeros(()))
            continue
        forth = torch.stack([torch.stack([(p - q).square().sum() for q in second]).min()
                             for p in first])  # fmt: skip
        back = torch.stack([torch.stack([(p - q).square().sum() for p in first]).min()
                            for q in second])  # fmt: skip
        result.append(forth.mean() + back.mean())
    return torch.stack(result)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 3), st.integers(1, 9), st.integers(1, 9), st.integers(0, 10_000))
def test_values_and_gradients_against_brute_force(b: int, n: int, m: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    a, c = (torch.randn(b, k, 3, generator=generator, dtype=torch.float64) for k in (n, m))
    mask_a, mask_c = (torch.rand(b, k, generator=generator) < 0.6 for k in (n, m))
    a.requires_grad_()
    c.requires_grad_()
    ours = masked_chamfer(a, c, mask_a, mask_c)
    theirs = brute_force(a, c, mask_a, mask_c)
    torch.testing.assert_close(ours, theirs)
    if theirs.requires_grad:
        mine = torch.autograd.grad(ours.sum(), (a, c))
        other = torch.autograd.grad(theirs.sum(), (a, c), allow_unused=True)
        for x, y in zip(mine, other, strict=True):
            torch.testing.assert_close(x, torch.zeros_like(x) if y is None else y)


def test_voxels_and_centres_known_answers() -> None:
    third = 1 / 3
    points = torch.tensor(
        [[[-1, -1, -1], [0, 0, 0], [0.9, -0.9, 0], [1, 1, 1], [2, -2, 0.5], [-0.34, 0.32, third]]]
    )
    # 9 i + 3 j + k; a point outside belongs to the nearest voxel
    assert voxel_of(points)[0, :5].tolist() == [0, 13, 18 + 0 + 1, 26, 18 + 0 + 2]
    assert voxel_of(points)[0, 5] // 3 == 1  # x in the first third, y in the second
    centres = voxel_centre(torch.tensor([0, 13, 19, 26]))
    expected = torch.tensor([[-2, -2, -2], [0, 0, 0], [2, -2, 0], [2, 2, 2]]) / 3
    torch.testing.assert_close(centres, expected)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 4), st.integers(1, 80), st.integers(1, 300), st.integers(0, 10_000))
def test_against_a_loop_over_clouds(b: int, n: int, least: int, seed: int) -> None:
    points = torch.rand(b, n, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    found = deform(points, torch.Generator().manual_seed(seed), least)
    order = torch.randperm(VOXELS, generator=torch.Generator().manual_seed(seed)).tolist()
    for i in range(b):
        count = torch.bincount(voxel_of(points)[i], minlength=VOXELS)
        first = next((v for v in order if count[v] / n >= least / 1024), None)
        if first is None:
            assert not found.mask[i].any()
        else:
            assert found.voxel[i] == first
            assert torch.equal(found.mask[i], voxel_of(points)[i] == first)
        kept = ~found.mask[i]
        assert torch.equal(found.points[i][kept], points[i][kept])


@pytest.mark.parametrize(
    ("method", "terms"),
    [
        (Gast(min_points=2, rot_weight=0.0), ("def_source", "def_target")),
        (DefRec(min_points=2, dropout=0.0), ("defrec",)),
        (Mlsp(min_points=2, dropout=0.0, pcm=False), ("position", "normal", "cardinality")),
    ],
)
def test_a_cloud_s_size_changes_nothing_but_what_the_net_sees(method, terms) -> None:
    """Clouds of 0.2 to 3 m: the loss of the unit ball, if the net divides by their size."""
    net = tiny_net()
    features, seen = net.features, []
    generator = torch.Generator().manual_seed(3)
    clouds = torch.randn(6, 64, 3, generator=generator)
    clouds = clouds / cloud_size(clouds)
    size = torch.tensor([0.2, 0.5, 1.0, 1.3, 2.0, 3.0])[:, None, None]
    labels = torch.arange(6) % 4

    def loss(points: torch.Tensor, divide: torch.Tensor | float) -> dict[str, torch.Tensor]:
        net.features = lambda x: (seen.append(x), features(x / divide))[1]
        batch = {"source": {"points": points, "y_source": labels}, "target": {"points": points}}
        return method.loss(net, batch, torch.Generator().manual_seed(0))

    method.prepare(net)
    method.metres = False
    unit = loss(clouds, 1.0)
    in_unit_ball, seen = seen[-1], []
    method.metres = True
    metres = loss(clouds * size, size)
    for term in terms:
        torch.testing.assert_close(metres[term], unit[term])
    torch.testing.assert_close(seen[-1], in_unit_ball * size)
    assert cloud_size(torch.zeros(2, 5, 3)).flatten().tolist() == [1.0, 1.0]
