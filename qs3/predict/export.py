"""A trained net as one file for `torch.export.load`, which needs no qs3."""

from __future__ import annotations

import copy
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import ConfigError, Qs3Error
from qs3.files import atomic_path
from qs3.inference import Predictor, load
from qs3.models.base import PointClassifier
from qs3.models.norms import norms_for, use_domain
from qs3.settings import whole

ALLOWED = 1e-4  # difference of logits


class _Logits(nn.Module):
    """A classifier without the check of its input, whose answer no graph can wait for."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b c"]:
        """Logits of prepared clouds."""
        if isinstance(self.net, PointClassifier):
            return self.net.head(self.net.backbone(points).global_)
        return self.net(points)


def export_command(ckpt: str | Path, out: str | Path, batch_size: int = 1, threads: int = 1) -> str:
    """Export a run's classifier and compare; text for the terminal."""
    torch.set_num_threads(whole("threads", threads, 1))
    predictor = load(ckpt)
    difference = export(predictor, out, batch_size)
    shape = [batch_size, predictor.points, 3]
    return (
        f"logits of the exported net differ by at most {difference:.1e}\n"
        f"saved {out}: torch.export.load({str(out)!r}).module() takes float32 {shape}, prepared\n"
        f"clouds, and gives logits of {', '.join(predictor.classes)}; NaN is not noticed"
    )


def export(predictor: Predictor, out: str | Path, batch_size: int = 1) -> float:
    """Write the net to `out`, read it back, and compare it with the net on clouds drawn at random.

    The exported net takes exactly `batch_size` clouds: what a layer does depends on how many
    there are.

    Returns:
        The largest difference of logits.

    Raises:
        ConfigError: a name that does not end in .pt2.
        Qs3Error: torch cannot export this net, or the logits differ by more than 1e-4: then there
            is no file.
    """
    out = Path(out).expanduser()
    if out.suffix != ".pt2":
        raise ConfigError(f"out={out} must end in .pt2")
    # A copy that nobody trains: some operations of the graph have no gradients.
    net = copy.deepcopy(predictor.net).requires_grad_(False)
    target = predictor.result.model["_target_"]
    generator = torch.Generator().manual_seed(0)
    clouds = torch.randn(
        2, whole("batch_size", batch_size, 1), predictor.points, 3, generator=generator
    )
    clouds = clouds / clouds.norm(dim=3, keepdim=True).amax(dim=2, keepdim=True)
    clouds = clouds.to(predictor.device)
    with _quiet(), use_domain(net, norms_for(net, "target")):
        try:
            with torch.no_grad():
                graph = _traced(_Logits(net).eval(), clouds[0])
        except Exception as error:  # torch raises dozens of kinds
            first = (str(error).splitlines() or [""])[0]
            raise Qs3Error(
                f"torch {torch.__version__} cannot export {target}: its layers do what depends on "
                "values, which a graph cannot hold; use it by qs3.load "
                f"({type(error).__name__}: {first[:200]})"
            ) from error
        with atomic_path(out) as temporary:
            torch.export.save(graph, temporary)
            again = torch.export.load(temporary).module()
            difference = float((again(clouds[1]) - net(clouds[1])).abs().max())
            if not difference <= ALLOWED:
                raise Qs3Error(
                    f"the exported net's logits differ by {difference:.1e}, more than {ALLOWED:g}; "
                    f"{out} was not written"
                )
    return difference


def _traced(net: nn.Module, example: Tensor) -> torch.export.ExportedProgram:
    """The net as a graph of plain operations: nested ones (autocast) cannot be read back."""
    return torch.export.export(net, (example,), strict=False).run_decompositions({})


@contextmanager
def _quiet() -> Iterator[None]:
    """Without torch's reports for those who write nets; what matters comes as an exception."""
    logger = logging.getLogger("torch")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            # Of tensors that share memory; the logits are compared after reading back.
            warnings.filterwarnings("ignore", message="No complete tensor found")
            yield
    finally:
        logger.setLevel(level)
