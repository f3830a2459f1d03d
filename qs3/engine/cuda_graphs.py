"""Passes of a training step as CUDA graphs: the host starts one graph, not each of its kernels.

A step of small clouds takes a GPU less time than Python takes to start its 180 kernels. A graph
replays the very kernels on memory that stays in place, so figures are those without it to the bit,
dropout's included.
"""

from __future__ import annotations

import copy
import gc
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

from qs3 import kernels as fast
from qs3.models.base import Features, PointClassifier, check_points

log = logging.getLogger(__name__)

Pass = Callable[[Tensor], tuple[Tensor, ...]]
Capture = Callable[[nn.Module, Tensor], Pass]
EAGER = 8
"""How often a pass is made as usual before it is captured, which costs as much as some of them."""
MOST = 16
"""Graphs of one module: each keeps its activations in memory."""
_KNOWN = 256
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")


class Graphs:
    """The graphs of a net's passes in training mode.

    A step may have several passes; the first, the second, ... have graphs of their own, as each
    needs its activations until the way back. What else a pass depends on is compared with what was
    captured: points' shapes and strides; which modules, parameters and buffers the net consists of
    and which are trained; every number and word among the modules' attributes, such as modes,
    dropout's rate and a domain's name. Passes that differ in it are made as usual, as are those in
    evaluation mode, without gradients, in autocast, of points that want a gradient, and those
    through modules with hooks. Chance must come from torch's generator of the device. Outputs that
    the loss does not use have gradients of zero, so what they alone depend on has such, not none.

    Args:
        net: whose `forward` and `features` are captured.
        capture: makes a pass a graph, see `captured`.

    Attributes:
        stand_in: what a loss calls in place of `net`, which it is but for its passes.
    """

    def __init__(self, net: PointClassifier, capture: Capture | None = None) -> None:
        self.capture = capture or captured
        self.off = False
        self.whole, self.backbone = _Passes(self, net), _Passes(self, net.backbone)
        self.stand_in = _stand_in(net, self.whole, self.backbone)

    def begin_step(self) -> None:
        """The next pass is its step's first."""
        self.whole.place = self.backbone.place = 0

    def forget(self) -> None:
        """Give the graphs' memory back: other shapes come."""
        for passes in (self.whole, self.backbone):
            passes.seen.clear()
            passes.graphs.clear()
        gc.collect()  # what torch makes of a pass is a class, which refers to itself
        if torch.cuda.is_available():
            torch.cuda.empty_cache()  # a graph's memory serves no other

    def give_up(self, error: Exception) -> None:
        """Go on without graphs, also those there are: they know torch's generator as it was."""
        self.off = True
        self.forget()
        why = str(error).split("\n", 1)[0]
        log.warning("no CUDA graphs of this net, steps go on without (%s)", why)


def _stand_in(net: PointClassifier, whole: _Passes, backbone: _Passes) -> Any:
    """The net under another class, whose passes are these; its modules and attributes are shared.

    A copy of it is one of the net: graphs are of the weights in their place.
    """
    kind: Any = type(net)

    class StandIn(kind):
        def __call__(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
            return whole(points)

        def features(self, points: Float[Tensor, "b n 3"]) -> Features:
            if kind.features is not PointClassifier.features:
                return super().features(points)
            check_points(points)
            return backbone(points)

        def __copy__(self) -> Any:
            return copy.copy(net)

        def __deepcopy__(self, memo: Any) -> Any:
            return copy.deepcopy(net, memo)

    one = StandIn.__new__(StandIn)
    object.__setattr__(one, "__dict__", net.__dict__)
    return one


class _Passes:
    """The passes of a step through one module."""

    def __init__(self, of: Graphs, module: nn.Module) -> None:
        self.of, self.module = of, module
        self.parts: _Parts | None = None
        self.place = 0
        self.seen: Counter[Hashable] = Counter()
        self.graphs: dict[Hashable, _Graph] = {}

    def __call__(self, points: Tensor) -> Any:
        if self.of.off or not self._can_be_captured(points):
            return self.module(points)
        assert self.parts is not None
        self.place += 1
        shown = points.shape, points.stride(), points.dtype
        key = (self.place, *shown, fast.is_plain(), self.parts.state())
        if key not in self.graphs:
            if len(self.seen) > _KNOWN:  # sizes that are drawn anew each step
                self.seen.clear()
            self.seen[key] += 1
            if self.seen[key] <= EAGER or len(self.graphs) == MOST:
                return self.module(points)
            try:
                self.graphs[key] = _Graph(self.module, points, self.of.capture)
            except Exception as error:
                self.of.give_up(error)
                return self.module(points)
        return self.graphs[key](points)

    def _can_be_captured(self, points: Tensor) -> bool:
        if (
            not torch.is_grad_enabled()
            or points.requires_grad
            or torch.is_autocast_enabled(points.device.type)
            or not self.module.training
        ):
            return False
        if self.parts is None:
            self.parts = _Parts(self.module)
        return self.parts.are_there() and not any(self.parts.hooks)


class _Parts:
    """What a module consists of: graphs know tensors by their place in memory."""

    def __init__(self, module: nn.Module) -> None:
        modules = list(module.modules())
        self.slots = [slots for m in modules for slots in (m._parameters, m._buffers, m._modules)]
        self.filled = self._now()
        self.weights = list(module.parameters())
        plain = (bool, int, float, str, type(None))
        self.values = [
            (vars(m), name) for m in modules for name, x in vars(m).items() if isinstance(x, plain)
        ]
        self.hooks = [vars(m)[kind] for m in modules for kind in _HOOKS]

    def _now(self) -> list[Any]:
        return [part for slots in self.slots for part in slots.values()]

    def are_there(self) -> bool:
        """Whether each is still the one it was, and none has come."""
        return [*map(id, self._now())] == [*map(id, self.filled)]

    def state(self) -> tuple[Hashable, ...]:
        """Every number and word of the modules, and which weights are trained."""
        values = tuple(found.get(name) for found, name in self.values)
        return (*values, *(p.requires_grad for p in self.weights))


class _Graph:
    """A captured pass, in the module's own kind of outputs."""

    def __init__(self, module: nn.Module, points: Tensor, capture: Capture) -> None:
        self.module = _Tensors(module)
        self.replay = capture(self.module, points)
        self.replays = 0

    def __call__(self, points: Tensor) -> Any:
        found = iter(_Copied.apply(self, *self.replay(points)))
        spec, are_tensors = self.module.spec
        return tree_unflatten([next(found) if one else None for one in are_tensors], spec)


class _Copied(torch.autograd.Function):
    """Outputs outside of a graph's memory, which the next step's replay writes over.

    On the way back the activations there are used up.
    """

    @staticmethod
    def forward(ctx: Any, graph: _Graph, *outputs: Tensor) -> tuple[Tensor, ...]:
        graph.replays += 1
        ctx.graph, ctx.turn, ctx.done = graph, graph.replays, False
        return tuple(one.clone() for one in outputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        if ctx.done or ctx.turn != ctx.graph.replays:
            raise RuntimeError("a replayed pass goes back once: set trainer.cuda_graphs=false")
        ctx.done = True
        return None, *grads


class _Tensors(nn.Module):
    """A module's forward pass, of whose outputs all are tensors, as torch asks for it."""

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
        Exception: a pass waits for the device, or has something else that no graph can hold.
    """
    names, weights = zip(*module.named_parameters(), strict=True)
    # Leaves of their own: those of passes before are of another stream, which a capture refuses.
    leaves = [w.detach().requires_grad_(w.requires_grad) for w in weights]

    def run(points: Tensor, *given: Tensor) -> Any:
        return functional_call(module, dict(zip(names, given, strict=True)), (points,))

    buffers = [(buffer, buffer.clone()) for buffer in module.buffers()]
    drawn = torch.cuda.get_rng_state(points.device)
    try:
        with _capturing(points.device):
            graphed: Any = torch.cuda.make_graphed_callables(
                run, (points.clone(), *leaves), allow_unused_input=True
            )
    except Exception:
        # A capture that failed leaves torch's generator waiting for its end.
        generator = torch.cuda.default_generators[points.device.index or 0]
        generator.graphsafe_set_state(torch.Generator(points.device).graphsafe_get_state())
        raise
    finally:
        with torch.no_grad():
            for buffer, value in buffers:
                buffer.copy_(value)
        torch.cuda.set_rng_state(drawn, points.device)
    return lambda points: graphed(points, *weights)


@contextmanager
def _capturing(device: torch.device) -> Iterator[None]:
    """Captures on this device; afterwards the current stream is that of before, whatever fails.

    torch keeps one stream for all captures of a process, of the first one's GPU: on another's
    nothing would be captured, of which torch only warns. It also warns of its own warm-up's stream.
    """
    kept = torch.cuda.graph.default_capture_stream
    if kept is not None and kept.device != device:
        torch.cuda.graph.default_capture_stream = None
    with (
        torch.cuda.device(device),
        torch.cuda.stream(torch.cuda.current_stream(device)),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message="The AccumulateGrad node's stream does not match")
        warnings.filterwarnings("error", message="The CUDA Graph is empty")
        yield
