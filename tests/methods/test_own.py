"""A method in a user's file: the page's example, what is refused, and that its content counts."""

from __future__ import annotations

import hashlib
import re
import sys
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.nn import functional as F

import qs3.config.hydra  # noqa: F401 (registers the resolvers)
from qs3.config.hashing import config_hash
from qs3.datamodules.augment import rotate_z
from qs3.errors import ConfigError, MissingDataError, Qs3Error
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


def of(folder: Path, text: str, **settings):
    file = folder / "method.py"
    file.write_text(text)
    return own(str(file), hashlib.sha256(text.encode()).hexdigest(), **settings)


def test_the_page_s_example_is_the_formula_it_states(tmp_path):
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
    (gradient,) = torch.autograd.grad(found["turned"], net[1].bias)
    assert gradient.abs().max() > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "expected one class derived .*; found none"),
        ("from qs3.methods.pcm import Pcm", "found none"),  # imported there, not defined
        (METHOD.format(name="A") + METHOD.format(name="B"), "found A, B"),
        (
            "from qs3.methods.base import Method\nclass A(Method): pass",
            "a loss of its own; found A",
        ),
        ("\n\nx = 1 / 0", r"method\.py, line 3: ZeroDivisionError: division by zero"),
        ("import torch\ntorch.zeros(-1)", r"line 2: RuntimeError: "),
        ("x = 1\ny = (", r"line 2: SyntaxError: "),
        ("import no_such_module", r"line 1: ModuleNotFoundError: No module named 'no_such_module'"),
        (METHOD.format(name="A") + "    labels = 'target_train'", r"A\.labels is 'target_train'"),
        (
            "from qs3.methods.supervised import Supervised\nclass A(Supervised): pass",
            r"gets labels of the source alone",
        ),
    ],
)
def test_what_is_refused(tmp_path, text, message):
    for _ in range(2):  # a module that failed is not taken for one that was imported
        with pytest.raises(ConfigError, match=message) as caught:
            of(tmp_path, text)
        assert "method.py" in str(caught.value)


def test_settings_that_it_does_not_have(tmp_path):
    with pytest.raises(ConfigError, match=r"A: .*unexpected keyword argument 'wieght'"):
        of(tmp_path, METHOD.format(name="A"), wieght=1.0)


def test_a_file_that_changed_is_not_run(tmp_path):
    file = tmp_path / "method.py"
    file.write_text(METHOD.format(name="A"))
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    ran = tmp_path / "ran"
    file.write_text(f"open({str(ran)!r}, 'w')")
    with pytest.raises(ConfigError, match="has changed since this run was asked for"):
        own(str(file), digest)
    assert not ran.exists()
    with pytest.raises(MissingDataError, match="cannot be read"):
        own(str(tmp_path / "no.py"), digest)


def test_what_a_module_needs_of_itself(tmp_path):
    """A dataclass with postponed annotations asks for its module by name."""
    text = f"""
from __future__ import annotations
from dataclasses import dataclass
@dataclass(frozen=True)
class Settings:
    weight: float = 1.0
{METHOD.format(name="A")}
"""
    assert type(of(tmp_path, text)).__name__ == "A"


def test_annotations_are_what_they_are_in_the_file(tmp_path):
    """Not texts, as in files that ask for it: somebody's own code may look at them."""
    text = METHOD.format(name="A") + "def size(n: int): ...\n"
    module = sys.modules[type(of(tmp_path, text)).__module__]
    assert module.size.__annotations__ == {"n": int}


def test_a_run_is_named_by_the_content_not_by_the_place(tmp_path):
    def name(file: Path) -> str:
        return config_hash(compose("train", ["method=own", f"method.file={file}"]))

    first, second = tmp_path / "first.py", tmp_path / "second.py"
    first.write_text(METHOD.format(name="A"))
    second.write_text(METHOD.format(name="A"))
    before = name(first)
    assert before == name(second)
    given = hashlib.sha256(first.read_bytes()).hexdigest()
    words = ["method=own", f"method.file={first}", f"method.sha256={given}"]
    assert config_hash(compose("train", words)) == before
    first.write_text(METHOD.format(name="B"))
    assert before != name(first)
    assert before == config_hash(compose("train", words))  # what is asked for is what was given
    assert name(second) != config_hash(
        compose("train", ["method=own", f"method.file={second}", "+method.weight=0.5"])
    )


def test_a_run_keeps_its_name_while_the_file_is_edited(tmp_path):
    file = tmp_path / "method.py"
    file.write_text(METHOD.format(name="A"))
    cfg = compose("train", ["method=own", f"method.file={file}"])
    before = config_hash(cfg)
    file.write_text(METHOD.format(name="B"))
    assert config_hash(cfg) == before
    with pytest.raises(Qs3Error, match="has changed since"):
        own(**{key: cfg.method[key] for key in ("file", "sha256")})
