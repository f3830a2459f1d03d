import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.defrec import VOXELS, DefRec, cloud_size, deform, voxel_centre, voxel_of
from qs3.methods.gast import Gast
from qs3.methods.mlsp import Mlsp
from tests.methods.shapes import tiny_net


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
    every = torch.arange(VOXELS)
    assert torch.equal(voxel_of(voxel_centre(every)[None])[0], every)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 4), st.integers(1, 80), st.integers(1, 300), st.integers(0, 10_000))
def test_against_a_loop_over_clouds(b: int, n: int, least: int, seed: int) -> None:
    points = torch.rand(b, n, 3, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    before = points.clone()
    found = deform(points, torch.Generator().manual_seed(seed), least)
    assert torch.equal(points, before)
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


def test_a_quarter_of_the_points_needs_a_quarter_in_a_voxel() -> None:
    """DefRec's 40 of 1,024 are 10 of 256: the same voxels may be deformed."""
    few = torch.full((2, 256, 3), 0.9)  # all in voxel 26, but for 10 and 9 in voxel 0
    few[0, :10] = few[1, :9] = -0.9
    drawn = set()
    for seed in range(40):
        thin, dense = (
            deform(points, torch.Generator().manual_seed(seed), 40)
            for points in (few, few.repeat(1, 4, 1))
        )
        assert torch.equal(thin.voxel, dense.voxel)
        drawn |= {(i, v) for i, v in enumerate(thin.voxel.tolist())}
    assert drawn == {(0, 0), (0, 26), (1, 26)}


def test_the_blob_s_law() -> None:
    points = torch.full((8, 500, 3), 0.1)  # all in the middle voxel
    found = deform(points, torch.Generator().manual_seed(0), 40)
    assert found.mask.all()
    assert found.voxel.tolist() == [13] * 8
    flat = found.points.flatten(0, 1)
    assert flat.mean(0).abs().max() < 0.003
    assert flat.var(0).numpy() == pytest.approx(0.001, rel=0.1)


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
