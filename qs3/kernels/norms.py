"""Norms by name, and what adaptation does with them: one a domain, or estimated anew.

- "batch": batch norm; its running statistics serve in eval.
- "instance": over each cloud (of SimpleView, each image) alone, in eval too (Ulyanov et al., 2016).
  In class heads, where a cloud is one vector and has no statistics, it is batch norm.
- "domain": a whole batch norm for each domain, statistics and affine, as in DSBN (Chang et al.,
  "Domain-Specific Batch Normalization for Unsupervised Domain Adaptation", CVPR 2019, eq. 3).

A pass is marked as being on a domain by `with use_domain(net, "target"): net(points)`; in
evaluation `use_trained` instead.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Literal
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import ConfigError

Norm = Literal["batch", "instance", "domain"]
DOMAINS = ("source", "target")
_Norm = nn.modules.batchnorm._NormBase
_BatchNorm = nn.modules.batchnorm._BatchNorm
_LAST_COUNT: WeakKeyDictionary[nn.Module, int] = WeakKeyDictionary()  # of `track`, for AdaBN


class DomainNorm(nn.Module):
    """A batch norm for each of `DOMAINS`; the current one is used, "source" at first.

    Args:
        channels: C, of [R, C] or [B, C, N].
        images: it is for [B, C, H, W] instead.
    """

    def __init__(self, channels: int, *, images: bool = False) -> None:
        super().__init__()
        plain = nn.BatchNorm2d if images else nn.BatchNorm1d
        self.source, self.target = plain(channels), plain(channels)
        self.domain = "source"

    @property
    def current(self) -> nn.BatchNorm1d | nn.BatchNorm2d:
        """The norm of the current domain."""
        return self.target if self.domain == "target" else self.source

    def forward(self, x: Tensor) -> Tensor:
        """As the current domain's batch norm."""
        return self.current(x)


def make_norm(kind: Norm, channels: int, *, images: bool = False) -> nn.Module:
    """The norm of that name for [R, C] (not "instance") or [B, C, N], or for `images` [B, C, H, W].

    Layers that compute the statistics themselves take parameters and running statistics from
    `active(norm)` and hand in what they found with `track`.
    """
    if kind == "batch":
        return nn.BatchNorm2d(channels) if images else nn.BatchNorm1d(channels)
    if kind == "instance":
        plain = nn.InstanceNorm2d if images else nn.InstanceNorm1d
        return plain(channels, affine=True)
    return DomainNorm(channels, images=images)


def head_norm(kind: Norm) -> Norm:
    """The kind to use where each cloud is one vector: instance norm has nothing to do there."""
    return "batch" if kind == "instance" else kind


def active(norm: nn.Module) -> _Norm:
    """The plain norm that a pass uses now: of the current domain, if `norm` has several."""
    found = norm.current if isinstance(norm, DomainNorm) else norm
    assert isinstance(found, _Norm)
    return found


def normed(norm: nn.Module, x: Float[Tensor, "b *places c"]) -> Float[Tensor, "b *places c"]:
    """A norm of the last axis; an instance norm has statistics of each cloud's places."""
    if isinstance(norm, nn.InstanceNorm1d):  # takes [b, c, n]
        return norm(x.flatten(1, -2).transpose(1, 2)).transpose(1, 2).view(x.shape)
    return norm(x.flatten(0, -2)).view(x.shape)


def running(norm: _Norm) -> tuple[Tensor, Tensor]:
    """Running mean and variance [C] of a plain norm that keeps them."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return norm.running_mean, norm.running_var


def uses_batch(norm: nn.Module) -> bool:
    """Whether a pass takes statistics of its input, rather than the running ones."""
    norm = active(norm)
    return norm.training or norm.running_mean is None


@torch.no_grad()
def track(norm: nn.Module, mean: Tensor, var: Tensor, count: int) -> None:
    """Update running statistics as `nn.BatchNorm1d` does; nothing if the norm keeps none.

    By mean and biased variance [C] of a batch of `count` values.
    """
    norm = active(norm)
    if not norm.training or norm.running_mean is None or norm.running_var is None:
        return
    assert norm.num_batches_tracked is not None
    norm.num_batches_tracked += 1
    _LAST_COUNT[norm] = count
    momentum = norm.momentum
    if momentum is None:  # torch's cumulative average
        momentum = 1.0 / float(norm.num_batches_tracked)
    unbiased = var * (count / max(count - 1, 1))
    norm.running_mean.lerp_(mean.to(norm.running_mean), momentum)
    norm.running_var.lerp_(unbiased.to(norm.running_var), momentum)


def statistics(norm: nn.Module, mean: Tensor, var: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """What a pass normalises by: these of the batch, which are `track`ed, or the running ones."""
    norm = active(norm)
    if uses_batch(norm):
        track(norm, mean.detach(), var.detach(), count)
        return mean, var
    return running(norm)


@contextmanager
def use_domain(net: nn.Module, domain: str) -> Iterator[None]:
    """Passes of `net` inside use the norms of `domain`; afterwards those of before.

    Nothing happens in a net without domain-specific norms, so callers need not ask.
    """
    assert domain in DOMAINS, domain
    with _using({norm: domain for norm in _domain_norms(net)}):
        yield


@contextmanager
def use_trained(net: nn.Module, domain: str) -> Iterator[None]:
    """As `use_domain`, for clouds of `domain` in evaluation: each layer by a norm that was trained.

    That of `domain`, or the other one where that never saw a cloud; the source's if neither did.
    So a net whose backbone alone has seen the target serves it with the backbone's norms of the
    target and the head's of the source.
    """
    assert domain in DOMAINS, domain
    with _using({norm: _trained(norm, domain) for norm in _domain_norms(net)}):
        yield


@contextmanager
def _using(domains: dict[DomainNorm, str]) -> Iterator[None]:
    before = {norm: norm.domain for norm in domains}
    for norm, domain in domains.items():
        norm.domain = domain
    try:
        yield
    finally:
        for norm, domain in before.items():
            norm.domain = domain


def _domain_norms(net: nn.Module) -> list[DomainNorm]:
    return [module for module in net.modules() if isinstance(module, DomainNorm)]


def _trained(norm: DomainNorm, domain: str) -> str:
    """The domain whose norm a layer uses for clouds of `domain` in evaluation."""
    for one in (domain, *DOMAINS):
        if int(getattr(norm, one).num_batches_tracked):
            return one
    return "source"


def begin_target_norms(net: nn.Module) -> None:
    """Give target norms that were never trained the source's weights and statistics.

    A student that goes on with a teacher which never saw the target would otherwise leave it in
    its first step, as the teacher used the source's norms. They count as never trained until a
    pass.
    """
    for norm in _domain_norms(net):
        if not norm.target.num_batches_tracked:
            norm.target.load_state_dict(norm.source.state_dict())
            assert norm.target.num_batches_tracked is not None
            norm.target.num_batches_tracked.zero_()


class _Pooled:
    """Mean and biased variance of a norm's input over all batches (Chan et al., 1979), float64."""

    def __init__(self, norm: _BatchNorm) -> None:
        mean, var = running(norm)
        self.norm, self.before, self.total = norm, (mean.clone(), var.clone()), 0
        self.mean = torch.zeros_like(mean, dtype=torch.float64)
        self.squares = torch.zeros_like(self.mean)  # sum of squares about the mean

    def add(self, count: int) -> None:
        """What the norm holds after a pass with momentum 1: this batch's mean and variance."""
        mean, var = running(self.norm)
        step = mean.double() - self.mean
        total = self.total + count
        self.squares += var.double() * (count - 1)
        self.squares += step.square() * (self.total * count / total)
        self.mean += step * (count / total)
        self.total = total

    def store(self, kept: float) -> None:
        new_var = self.squares / max(self.total - 1, 1)
        for held, new, old in zip(
            running(self.norm), (self.mean, new_var), self.before, strict=True
        ):
            held.copy_(new.lerp(old.double(), kept))


@torch.no_grad()
def adapt_batchnorm(
    net: nn.Module, batches: Iterable[Tensor], kept: float = 0.0
) -> list[nn.Module]:
    """AdaBN: give every batch norm the statistics of these clouds (Li et al., 2016, alg. 1).

    No weight changes. One pass, in which a layer's input was normalised with the statistics of its
    own batch; means and variances are pooled over all batches.

    Args:
        net: takes a batch of clouds. Of domain-specific norms those of the current domain are
            re-estimated: call it inside `use_domain(net, "target")`.
        batches: of clouds [B, N, 3], of at least two each.
        kept: in [0, 1], the share of the former means and variances in what the norms then hold
            (alpha-BN: You et al., "Test-time Batch Statistics Calibration for Covariate Shift",
            arXiv 2110.04065, 2021; there a batch goes on normalised by the mix).

    Returns:
        The adapted norms.

    Raises:
        ConfigError: the net has no norm.
    """
    check_has_norms(net, "adabn")
    norms = running_norms(net)
    pooled = [_Pooled(norm) for norm in norms]

    def count(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        _LAST_COUNT[norm] = inputs[0].numel() // inputs[0].shape[1]

    hooks = [norm.register_forward_pre_hook(count) for norm in norms]
    modes = {module: module.training for module in net.modules()}
    momenta = [norm.momentum for norm in norms]
    try:
        net.eval()  # no dropout, and nothing else that is left to chance
        for norm in norms:
            norm.training, norm.momentum = True, 1.0
        for points in batches:
            for norm in norms:
                _LAST_COUNT.pop(norm, None)
            net(points)
            for norm, pool in zip(norms, pooled, strict=True):
                assert norm in _LAST_COUNT, "a layer that does not call its norm must use `track`"
                pool.add(_LAST_COUNT[norm])
    finally:
        for hook in hooks:
            hook.remove()
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum
        for module, mode in modes.items():
            module.training = mode
    assert pooled[0].total, "no batches to take statistics of"
    for pool in pooled:
        pool.store(kept)
    return list(norms)


def check_has_norms(net: nn.Module, what: str) -> None:
    """Raise ConfigError for a net without running statistics, of which nothing can adapt."""
    if not running_norms(net):
        raise ConfigError(f"evaluation.norms={what} adapts batch norms, and this net has none")


def running_norms(net: nn.Module) -> list[_BatchNorm]:
    """Norms with running statistics that a pass would use now."""
    asleep = {
        norm.source if norm.domain == "target" else norm.target
        for norm in net.modules()
        if isinstance(norm, DomainNorm)
    }
    found = [m for m in net.modules() if isinstance(m, _BatchNorm) and m.running_mean is not None]
    return [norm for norm in found if norm not in asleep]
