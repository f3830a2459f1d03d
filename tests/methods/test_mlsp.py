"""MLSP: its labels by loops, the loss pair by pair, and what the target teaches."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.methods.defrec import deform
from qs3.methods.mlsp import NEIGHBOURS, RADIUS, Mlsp, cardinalities, normals_of
from tests.methods.shapes import tiny_net


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 2), st.sampled_from([8, 64, 256]), st.integers(0, 10_000))
def test_cardinalities_by_loops(b: int, n: int, seed: int) -> None:
    points = 0.3 * torch.rand(b, n, 3, generator=torch.Generator().manual_seed(seed))
    found = cardinalities(points)
    for i in range(b):
        for j in range(0, n, 7):
            distance = (points[i] - points[i, j]).norm(dim=1)
            if (distance - RADIUS).abs().min() < 1e-6:  # rounding decides
                continue
            count = int((distance <= RADIUS).sum())
            assert found[i, j] == min(math.floor(count * 1024 / n / 2), 15)


def test_normals_are_those_of_eigenvectors() -> None:
    points = torch.randn(2, 40, 3, generator=torch.Generator().manual_seed(0)).double()
    found = normals_of(points)
    for i in range(2):
        for j in range(40):
            near = (points[i] - points[i, j]).norm(dim=1).topk(NEIGHBOURS, largest=False).indices
            around = points[i, near] - points[i, near].mean(0)
            value, vector = torch.linalg.eigh(around.T @ around)
            if value[1] > 2 * value[0]:  # else any direction between will do
                assert abs(found[i, j].double() @ vector[:, 0]) > 0.999


def test_the_loss_pair_by_pair() -> None:
    """Told at a position against the nearest original's truth, and the other way round."""
    net, clouds = tiny_net(), torch.rand(3, 64, 3) * 2 - 1
    method = Mlsp(0.5, 0.3, 0.1, min_points=48, pcm=False, dropout=0.0)
    method.prepare(net)
    assert method.head is not None
    net.eval()
    method.eval()
    source = {"points": clouds, "y_source": torch.arange(3)}
    batch = {"source": source, "target": {"points": clouds}}
    terms = method.loss(net, batch, torch.Generator().manual_seed(2))
    masked = deform(clouds, torch.Generator().manual_seed(2), 48)
    with torch.no_grad():
        told = method.head(net.features(masked.points))
    normals, counts = normals_of(clouds), cardinalities(clouds)
    sums = {"position": 0.0, "normal": 0.0, "cardinality": 0.0}
    for i in range(3):
        region = masked.mask[i].nonzero()[:, 0].tolist()
        pairs = []
        for j in region:
            gaps = [float((told[i, j, :3] - clouds[i, k]).norm()) for k in region]
            pairs.append((j, region[gaps.index(min(gaps))]))
            gaps = [float((told[i, k, :3] - clouds[i, j]).norm()) for k in region]
            pairs.append((region[gaps.index(min(gaps))], j))
        for at, original in pairs:
            position, normal, logits = told[i, at].split([3, 3, 16])
            cosine = torch.cosine_similarity(normal, normals[i, original], dim=0)
            values = (
                (position - clouds[i, original]).square().sum(),
                1 - cosine.abs(),
                -logits.log_softmax(0)[counts[i, original]],
            )
            for name, value in zip(sums, values, strict=True):
                sums[name] += float(value) / len(region) / 3
    for name, w in (("position", 10.0), ("normal", 0.3), ("cardinality", 0.1)):
        assert terms[name].item() == pytest.approx(w * sums[name], rel=1e-4), name
    ce = torch.nn.functional.cross_entropy(net(clouds), torch.arange(3))
    torch.testing.assert_close(terms["ce"], 0.5 * ce)
