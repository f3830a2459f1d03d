"""A user's method is tried on random clouds: what is wrong is said with its place in the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from qs3.errors import ConfigError
from qs3.methods.base import total_loss
from qs3.methods.source_only import SourceOnly
from qs3.methods.trial import random_batch, try_step
from tests.methods.cases import CASES, batch_of
from tests.methods.shapes import CLASSES, tiny_net
from tests.methods.test_own import example, of

HEAD = """
import torch
from torch import nn
from torch.nn import functional as F
from qs3.methods.base import Method
class Mine(Method):
"""
LOSS = """
    def loss(self, net, batch, generator):
        source = batch["source"]
        each = F.cross_entropy(net(source["points"]), source["y_source"], reduction="none")
        return {}
"""


def tried(folder: Path, text: str, net: nn.Module | None = None) -> None:
    method = of(folder, text)
    try_step(method, net or tiny_net(), "method.py", CLASSES, 16)


def test_the_page_s_example_passes_and_draws_nothing(tmp_path: Path) -> None:
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    tried(tmp_path, example())
    assert torch.equal(torch.rand(1), expected)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        ("each.mean()", r"by name, not a tensor \[\]"),
        ("{}", "by name, not an empty dict"),
        ("None", "by name, not of type NoneType"),
        ('{"class": each}', r"by name; 'class' is a tensor \[4\]"),
        ('{"class": each.mean().item()}', "by name; 'class' is of type float"),
        ('{"class": each.mean().detach()}', "no gradient leads back from class"),
        ('{"a": each.mean(), "b": 1}', "'b' is of type int"),
    ],
)
def test_a_loss_of_another_form_is_refused(tmp_path: Path, returned: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        tried(tmp_path, HEAD + LOSS.format(returned))
    assert "method.file=method.py: Mine.loss must return a dict of scalar" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (  # the target was not asked for
            LOSS.format('{"class": net(batch["target"]["points"]).sum()}'),
            r"line 11: KeyError: 'target'; a batch has \[\"source\"\] with points, y_source; "
            r"\[\"target\"\] is there with `uses_target = True`",
        ),
        (
            "    uses_target = True" + LOSS.format('{"class": batch["target"]["y_target"]}'),
            r"line 11: KeyError: 'y_target'; a batch has .*, \[\"target\"\] with points$",
        ),
        (
            "    def __init__(self):\n        self.weight = 1.0" + LOSS.format("{}"),
            r"Mine\.__init__ must begin with super\(\)\.__init__\(\)",
        ),
        (
            "    def prepare(self, net):\n        self.layer = nn.Linear(-1, 2)\n" + LOSS,
            r"line 8: RuntimeError: ",
        ),
        (LOSS.format('{"class": net(source["points"][:, 0])}'), "line 11: "),
    ],
)
def test_what_fails_is_named_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        tried(tmp_path, HEAD + text)
    assert "method.py" in str(caught.value).partition(": ")[0]


def test_a_loss_that_needs_its_epoch_is_left_alone(tmp_path: Path) -> None:
    """What `start_epoch` leaves is not there: `prepare` alone is tried."""
    epoch = "    def start_epoch(self, net, data, epoch, epochs):\n        self.pool = 1\n"
    tried(tmp_path, HEAD + epoch + LOSS.format('{"class": self.pool * each.mean()}'))
    with pytest.raises(ConfigError, match="has no attribute 'pool'"):
        tried(tmp_path, HEAD + LOSS.format('{"class": self.pool * each.mean()}'))


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if not case.pseudo])
def test_a_batch_is_as_a_run_s(name: str) -> None:
    """The same keys and shapes as of the batches that all methods are tested with."""
    method = CASES[name].make()
    method.labels, labels = "source", method.labels  # type: ignore[misc]

    def shapes(batch: dict[str, Any]) -> dict[str, Any]:
        parts = {key: part for key, part in batch.items() if isinstance(part, dict)}
        return {
            key: {k.replace(labels, "source"): x.shape for k, x in part.items()}
            for key, part in parts.items()
        }

    assert shapes(random_batch(method, 3, 16)) == shapes(batch_of(CASES[name], method, 4, 16, 3))


def test_total_is_the_sum() -> None:
    terms = {"a": torch.tensor(1.5, requires_grad=True), "b": torch.tensor(2.0)}
    assert total_loss(SourceOnly(), terms) == 3.5
