"""The method and the selector of docs/how-to/add-a-method.md are what the page says of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import nn
from torch.nn import functional as F

from qs3.kernels.norms import DomainNorm
from qs3.methods.base import Method
from qs3.selftraining.selectors import TeacherPredictions, chosen_by

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "add-a-method.md"


def part(cls: str) -> tuple[Any, dict[str, Any]]:
    """A class of the page, and the config that names it."""
    text, names = PAGE.read_text("utf-8"), {"__name__": "page"}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, PAGE.name, "exec"), names)
    configs = [yaml.safe_load(one) for one in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)]
    (config,) = (one for one in configs if str(one).find(f".{cls}'") >= 0)
    return names[cls], config


class Lifted(nn.Module):
    """A norm for each domain, then the mean over the points."""

    def __init__(self) -> None:
        super().__init__()
        self.norm, self.head = DomainNorm(3), nn.Linear(3, 3)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        return self.head(self.norm(points.transpose(1, 2)).relu().amax(dim=2))


def test_the_method_is_the_formula_it_states_by_the_norms_of_the_target() -> None:
    cls, config = part("Consistency")
    assert config.pop("_target_") == "qs3.methods.consistency.Consistency"
    method: Method = cls(**{**config, "weight": 0.7})
    torch.manual_seed(0)
    net, points, labels = Lifted(), torch.randn(2, 5, 8, 3), torch.arange(5) % 3
    batch = {"source": {"points": points[0], "y_source": labels}, "target": {"points": points[1]}}
    found = method.loss(net, batch, torch.Generator().manual_seed(3))
    assert [int(one.num_batches_tracked) for one in (net.norm.source, net.norm.target)] == [1, 2]
    half = points[1][:, torch.randperm(8, generator=torch.Generator().manual_seed(3))[:4]]
    torch.testing.assert_close(found["class"], F.cross_entropy(net(points[0]), labels))
    net.norm.domain = "target"
    p, q = net(points[1]).softmax(1), net(half).softmax(1)
    torch.testing.assert_close(found["consistency"], 0.7 * (p * (p / q).log()).sum(1).mean())


def test_the_selector_keeps_what_leads_by_more_than_theta() -> None:
    cls, config = part("Margin")
    assert (ROOT / "conf" / "selftraining" / f"{config['defaults'][0]}.yaml").is_file()
    p = np.array([[0.7, 0.2, 0.1], [0.5, 0.4, 0.1], [0.1, 0.3, 0.6], [0.9, 0.1, 0.0]])
    chosen = chosen_by(cls(), TeacherPredictions.of(p, "abcd"), 0.3, 0)
    assert chosen.selected.tolist() == [True, False, False, True]
    assert chosen.kept.tolist() == [2, 0, 0]
