"""SD's graph: joined as by loops, its net as by matrices, and labels that only neighbours mend."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.selftraining.sd import GraphNet, GraphRefined, neighbours_of, principal
from qs3.selftraining.selectors import TeacherPredictions


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 30), st.integers(3, 5), st.integers(1, 5), st.integers(0, 10_000))
def test_the_graph_by_loops(n: int, d: int, most: int, seed: int) -> None:
    features = torch.randn(n, d, generator=torch.Generator().manual_seed(seed)).double()
    table = np.corrcoef(features.numpy()).reshape(n, n)
    joined = np.eye(n)
    for i in range(n):
        others = sorted((j for j in range(n) if j != i), key=lambda j: -table[i, j])
        for j in others[:most]:
            if table[i, j] > 0.6:
                joined[i, j] = joined[j, i] = 1
    degree = joined.sum(1)
    expected = joined / np.sqrt(degree[:, None] * degree)
    found = neighbours_of(features, 0.6, most).to_dense().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_net_by_matrices() -> None:
    torch.manual_seed(0)
    net = GraphNet(5, 3).eval()
    x, scores = torch.randn(7, 5), torch.rand(7, 3)
    edges = neighbours_of(torch.randn(7, 4).double(), 0.0, 3)
    dense = edges.to_dense()
    z = x + scores @ net.of_scores.weight.T + net.of_scores.bias
    for i, layer in enumerate(net.layers):
        z = dense @ ((z.relu() if i else z) @ layer.weight.T + layer.bias)
    torch.testing.assert_close(net(x, scores, edges), z)


def test_principal_components_keep_distances() -> None:
    features = torch.randn(20, 6).double() @ torch.randn(6, 9).double()  # of rank 6
    found = principal(features, 7)
    scale = torch.cdist(features, features)[0, 1] / torch.cdist(found, found)[0, 1]
    torch.testing.assert_close(torch.cdist(found, found) * scale, torch.cdist(features, features))
    assert found.square().mean().item() == pytest.approx(1)


def _two_groups(wrong: float) -> tuple[TeacherPredictions, np.ndarray]:
    """60 clouds in three groups of features; of each, the teacher misnames a part, less surely."""
    rng = np.random.default_rng(0)
    truth = np.arange(60) % 3
    features = 3 * np.eye(3, 12)[truth] + 0.1 * rng.normal(size=(60, 12))
    named = np.where(rng.random(60) < wrong, (truth + 1) % 3, truth)
    p = np.full((60, 3), 0.15)
    p[np.arange(60), named] = 0.7
    return TeacherPredictions.of(p, [f"{i:02d}" for i in range(60)], features), truth


def test_neighbours_mend_labels_that_the_teacher_s_own_probabilities_cannot() -> None:
    teacher, truth = _two_groups(wrong=0.25)
    wrong = teacher.predicted != truth
    assert wrong.sum() >= 10
    chosen = {}
    for graph in (True, False):
        selector = GraphRefined(graph, growth=0.5, steps=150 if graph else 1000)
        found = selector.select(teacher, 0.0, round_=2)
        assert found.selected.all()
        chosen[graph] = found.labels
        assert found.soft is not None
        np.testing.assert_array_equal(found.soft.argmax(1), found.labels)
        np.testing.assert_allclose(found.soft.sum(1), 1.0)
    assert (chosen[True] == truth).all()
    assert (chosen[False] == teacher.predicted).all()


def test_the_first_round_and_the_unsure_keep_the_teacher_s_labels() -> None:
    teacher, _ = _two_groups(wrong=0.25)
    first = GraphRefined().select(teacher, 0.0, 0)
    np.testing.assert_array_equal(first.labels, teacher.predicted)
    np.testing.assert_allclose(first.soft.sum(1), 0.2)
    later = GraphRefined(growth=0.2, steps=20, unsure=0.1).select(teacher, 0.0, 1)
    sure = np.isclose(later.soft.sum(1), 1.0)
    assert 3 <= sure.sum() < 60
    np.testing.assert_allclose(later.soft.sum(1)[~sure], 0.1)
    np.testing.assert_array_equal(later.labels[~sure], teacher.predicted[~sure])


def test_each_class_has_at_least_one_that_is_sure() -> None:
    teacher, _ = _two_groups(wrong=0.0)
    found = GraphRefined(graph=False, growth=0.001).select(teacher, 0.0, 1)
    sure = np.isclose(found.soft.sum(1), 1.0)
    assert sorted(found.labels[sure]) == [0, 1, 2]


def test_the_order_of_the_rows_and_torch_s_generator_do_not_matter() -> None:
    teacher, _ = _two_groups(wrong=0.25)
    selector, order = GraphRefined(growth=0.4, steps=10), np.random.default_rng(1).permutation(60)
    state = torch.get_rng_state()
    here = selector.select(teacher, 0.0, 1)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(5)
    mixed = TeacherPredictions.of(
        teacher.probabilities[order], [teacher.ids[i] for i in order], teacher.features[order]
    )
    np.testing.assert_array_equal(selector.select(mixed, 0.0, 1).soft, here.soft[order])
    other = dataclasses.replace(selector, seed=1, steps=1).select(teacher, 0.0, 1)
    assert not np.array_equal(other.soft, here.soft)
