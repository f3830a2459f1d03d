"""Which products `trainer.float32_matmul=high` may round: not those of distances and coordinates.

The rounding itself is a GPU's; here it is looked at what each product would be told.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from qs3.geometry.neighbours import knn
from qs3.methods.defrec import masked_chamfer, nearest
from qs3.methods.gast import turn_parts
from qs3.methods.mlsp import cardinalities, normals_of
from qs3.methods.pointdan import mmd2
from tests.device import as_on_device
from tests.models.test_all_nets import build, each_net

PRODUCTS = ("mm", "bmm", "addmm", "baddbmm", "mv", "dot", "_euclidean_dist")


class Told(TorchDispatchMode):
    """Of each product: what it may round, and its two factors' shapes."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, list[list[int]]]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func._schema.name.split("::")[1].rstrip("_") in PRODUCTS:
            factors = [list(x.shape) for x in tree_leaves(args) if isinstance(x, Tensor)][-2:]
            self.found.append((torch.get_float32_matmul_precision(), factors))
        return func(*args, **(kwargs or {}))


@pytest.fixture(autouse=True)
def high() -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    yield
    torch.set_float32_matmul_precision(before)


def test_distances_and_turns_of_methods_are_exact() -> None:
    points, features = torch.randn(3, 40, 3), torch.randn(3, 40, 9)
    mask = torch.ones(3, 40, dtype=torch.bool)
    for ask in (
        lambda: knn(points, 5),
        lambda: knn(features, 5),
        lambda: masked_chamfer(points, points + 1, mask, mask),
        lambda: nearest(points, points + 1, mask, mask),
        lambda: normals_of(points),
        lambda: cardinalities(points),
        lambda: turn_parts(points, torch.Generator()),
        lambda: mmd2(features[0], features[1], (1.0,)),
    ):
        with as_on_device(), Told() as told:
            ask()
        assert [word for word, _ in told.found] == ["highest"] * len(told.found)
        assert told.found


@each_net
def test_nets_round_layers_but_no_coordinates(name: str) -> None:
    """Turned clouds stay exact, and distances; a first layer is a layer like others."""
    net = build(name, **({"variant": "defrec"} if name == "dgcnn" else {})).float().train()
    with as_on_device(), Told() as told:
        net(torch.randn(4, 128, 3))
    turns, distances, layers = [], [], []
    for word, (a, b) in told.found:
        if b == [4, 3, 3]:
            turns.append(word)
        elif len(a) == len(b) == 3 and b[2] == 128:  # to every point
            distances.append(word)
        else:
            layers.append(word)
    assert set(layers) <= {"high"}
    assert set(turns) | set(distances) <= {"highest"}
    assert len(turns) == (name in ("dgcnn", "pointnet", "pointdan"))
    assert len(distances) == {"dgcnn": 5, "committee": 4, "pointdan": 1}.get(name, 0)
