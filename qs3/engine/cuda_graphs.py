"""Passes of a training step as CUDA graphs: the host starts one graph, not each of its kernels.

A step of small clouds takes a GPU less time than Python takes to start its 180 kernels. A graph
replays the very kernels on memory that stays in place, so figures are those without it to the bit,
dropout's included.
"""

from __future__ import annotations

import copy
import logging
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils._pytree import TreeSpec, tree_flatten, tree_unflatten

from qs3.models.base import Features, PointClassifier
from qs3.models.norms import DomainNorm

log = logging.getLogger(__name__)

Pass = Callable[[Tensor], tuple[Tensor, ...]]
Capture = Callable[[nn.Module, Tensor], Pass]
EAGER = 8
"""How often a pass is made as usual before it is captured, which costs as much as some of them: an
epoch's last batch, which may be smaller, comes once an epoch."""


class GraphedNet:
    """What a method's loss calls as its net: passes in training mode become graphs.

    A step may have several passes; the first, the second, ... have graphs of their own, as each
    needs its activations until the way back. Whatever else a graph depends on but weights and
    points is compared: shapes, norms' domains and momenta, modes, which weights are trained. Passes
    in evaluation mode, without gradients, in autocast, of points that want a gradient, and those
    through modules with hooks are made as usual, as is everything beside a pass (heads of a method,
    losses, the optimiser). Everything else is asked of the net itself.

    Args:
        net: whose `forward` and `features` are captured.
        capture: makes a pass a graph, see `captured`.
    """

    def __init__(self, net: PointClassifier, capture: Capture | None = None) -> None:
        self.net = net
        capture = capture or captured
        self._whole, self._backbone = (_Passes(one, capture) for one in (net, net.backbone))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.net, name)

    def __deepcopy__(self, memo: Any) -> nn.Module:
        """A copy of the net: graphs are of the weights in their place."""
        return copy.deepcopy(self.net, memo)

    def __call__(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits."""
        return self._whole(points)

    def features(self, points: Float[Tensor, "b n 3"]) -> Features:
        """As `PointClassifier.features`; a device does not look at a training step's values."""
        return self._backbone(points)

    def begin_step(self) -> None:
        """The next pass is its step's first."""
        self._whole.place = self._backbone.place = 0

    def forget(self) -> None:
        """Give the graphs' memory back: other shapes come."""
        self._whole.forget()
        self._backbone.forget()


class _Passes:
    """The passes of a step through one module."""

    def __init__(self, module: nn.Module, capture: Capture) -> None:
        self.module, self.capture = module, capture
        self.place = 0
        self.off = False
        self.forget()

    def forget(self) -> None:
        self.seen: Counter[Hashable] = Counter()
        self.graphs: dict[Hashable, _Graph] = {}

    def __call__(self, points: Tensor) -> Any:
        if self.off or not self._can_be_captured(points):
            return self.module(points)
        self.place += 1
        key = (self.place, points.shape, points.dtype, *_state(self.module))
        if key not in self.graphs:
            self.seen[key] += 1
            if self.seen[key] <= EAGER:
                return self.module(points)
            try:
                self.graphs[key] = _Graph(self.module, points, self.capture)
            except RuntimeError as error:
                self.off = True
                why = str(error).split("\n", 1)[0]
                log.warning("no CUDA graphs of this net, steps go on without (%s)", why)
                return self.module(points)
        return self.graphs[key](points)

    def _can_be_captured(self, points: Tensor) -> bool:
        return (
            torch.is_grad_enabled()
            and not points.requires_grad
            and not torch.is_autocast_enabled(points.device.type)
            and self.module.training
            and not any(
                module._forward_hooks or module._forward_pre_hooks or module._backward_hooks
                for module in self.module.modules()
            )
        )


def _state(module: nn.Module) -> tuple[Hashable, ...]:
    """What decides which kernels a pass starts, and with which numbers, beside its tensors."""
    modules = list(module.modules())
    return (
        tuple(one.training for one in modules),
        tuple(one.domain for one in modules if isinstance(one, DomainNorm)),
        tuple(one.momentum for one in modules if isinstance(one, nn.modules.batchnorm._NormBase)),
        tuple(p.requires_grad for p in module.parameters()),
    )


class _Graph:
    """A captured pass, in the module's own kind of outputs."""

    def __init__(self, module: nn.Module, points: Tensor, capture: Capture) -> None:
        self.module = _Tensors(module)
        self.replay = capture(self.module, points)

    def __call__(self, points: Tensor) -> Any:
        # Copied, because the next step's replay writes where these lie.
        found = iter([one.clone() for one in self.replay(points)])
        spec, are_tensors = self.module.spec
        return tree_unflatten([next(found) if one else None for one in are_tensors], spec)


class _Tensors(nn.Module):
    """A module's forward pass, of whose outputs all are tensors, as torch asks for it.

    It is no hook's business, and torch puts its graphs into the module that it is given.
    """

    spec: tuple[TreeSpec, list[bool]]

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, points: Tensor) -> tuple[Tensor, ...]:
        leaves, spec = tree_flatten(self.module.forward(points))
        self.spec = spec, [leaf is not None for leaf in leaves]
        return tuple(leaf for leaf in leaves if leaf is not None)


def captured(module: nn.Module, points: Float[Tensor, "b n 3"]) -> Pass:
    """A pass as a graph, its way back as another; the module's state is as before.

    Neither its running statistics nor torch's generator keep anything of the passes that warm up.

    Args:
        module: points to a tuple of tensors, without hooks.
        points: of the shape and on the GPU of all that will be passed.

    Raises:
        RuntimeError: a pass waits for the device, or has something else that no graph can hold.
    """
    names, weights = zip(*module.named_parameters(), strict=True)
    # Leaves of their own: those of passes before are of another stream, which a capture refuses.
    leaves = [w.detach().requires_grad_(w.requires_grad) for w in weights]

    def run(points: Tensor, *given: Tensor) -> Any:
        return functional_call(module, dict(zip(names, given, strict=True)), (points,))

    buffers = [(buffer, buffer.clone()) for buffer in module.buffers()]
    drawn = torch.cuda.get_rng_state(points.device)
    try:
        # Whatever stream a failed capture ends on; torch warns of its own warm-up's.
        with torch.cuda.stream(torch.cuda.current_stream(points.device)), _quiet():
            graphed: Any = torch.cuda.make_graphed_callables(
                run, (points.clone(), *leaves), allow_unused_input=True
            )
    except RuntimeError:
        _new_generator(points.device)
        raise
    finally:
        with torch.no_grad():
            for buffer, value in buffers:
                buffer.copy_(value)
        torch.cuda.set_rng_state(drawn, points.device)
    return lambda points: graphed(points, *weights)


@contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The AccumulateGrad node's stream does not match")
        yield


def _new_generator(device: torch.device) -> None:
    """A capture that failed leaves torch's generator waiting for its end; it gets another state."""
    generator = torch.cuda.default_generators[device.index or 0]
    generator.graphsafe_set_state(torch.Generator(device).graphsafe_get_state())
