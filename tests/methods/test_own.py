"""A method in a user's file: the page's example, what is refused, and that its content counts."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.nn import functional as F

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hydra import config_hash
from qs3.datamodules.augment import rotate_z
from qs3.errors import ConfigError, MissingDataError
from qs3.methods.base import Method, total_loss
from qs3.methods.bounds import SourceOnly
from qs3.methods.own import own
from tests.composing import compose

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "leaderboard.md"
METHOD = """
from qs3.methods.base import Method
class {name}(Method):
    def loss(self, net, batch, generator):
        return {{}}
"""


def example() -> str:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    return str(block)


def of(folder: Path, text: str, **settings: Any) -> Method:
    file = folder / "method.py"
    file.write_text(text)
    return own(str(file), hashlib.sha256(text.encode()).hexdigest(), **settings)


def test_the_page_s_example_is_the_formula_it_states(tmp_path: Path) -> None:
    assert len([line for line in example().splitlines() if line.strip()]) <= 30
    method = of(tmp_path, example(), weight=0.7)
    assert method.uses_target
    net = nn.Sequential(nn.Flatten(), nn.Linear(24, 3))
    points, labels = torch.randn(2, 5, 8, 3), torch.arange(5) % 3
    batch = {
        "source": {"points": points[0], "y_source": labels},
        "target": {"points": points[1]},
        "progress": 0.25,
    }
    found = method.loss(net, batch, torch.Generator().manual_seed(3))
    angle = 2 * torch.pi * torch.rand(5, generator=torch.Generator().manual_seed(3))
    p, q = net(points[1]).softmax(1), net(rotate_z(points[1], angle)).softmax(1)
    kl = (p * (p / q).log()).sum(1).mean()
    torch.testing.assert_close(found["turned"], 0.7 * 0.25 * kl)
    torch.testing.assert_close(found["class"], F.cross_entropy(net(points[0]), labels))


@pytest.mark.parametrize(
    "text",
    [
        "from qs3.methods.pcm import Pcm",  # imported there, not defined
        METHOD.format(name="A") + METHOD.format(name="B"),
        METHOD.format(name="A") + "    labels = 'target_train'",
    ],
)
def test_a_file_without_one_method_of_the_source_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=r"method\.py"):
        of(tmp_path, text)


def test_a_file_that_changed_is_not_run(tmp_path: Path) -> None:
    file = tmp_path / "method.py"
    file.write_text(METHOD.format(name="A"))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    ran = tmp_path / "ran"
    file.write_text(f"open({str(ran)!r}, 'w')")
    with pytest.raises(ConfigError):
        own(str(file), digest)
    assert not ran.exists()
    with pytest.raises(MissingDataError):
        own(str(tmp_path / "no.py"), digest)


def test_a_run_is_named_by_the_content_not_by_the_place(tmp_path: Path) -> None:
    def name(file: Path) -> str:
        return config_hash(compose("train", ["method=own", f"method.file={file}"]))

    first, second = tmp_path / "first.py", tmp_path / "second.py"
    first.write_text(METHOD.format(name="A"))
    second.write_text(METHOD.format(name="A"))
    before = name(first)
    assert before == name(second)
    first.write_text(METHOD.format(name="B"))
    assert before != name(first)


def test_a_loss_of_each_cloud_is_refused() -> None:
    """It would be summed over the clouds."""
    with pytest.raises(ConfigError, match="'b'"):
        total_loss(SourceOnly(), {"b": torch.ones(4)})
