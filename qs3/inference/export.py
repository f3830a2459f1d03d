"""A trained net as one file that needs no qs3: .pt2 for `torch.export.load`, .onnx for runtimes.

Or as a folder to publish (`qs3.inference.model_file`) with a card: what the classifier is, how
accurate it was, what it lacks.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import logging
import re
import shlex
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml  # type: ignore[import-untyped,unused-ignore]
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import ConfigError, Qs3Error
from qs3.evaluation.validators import chosen_in_words
from qs3.inference.model_file import (
    CARD,
    CONFIG,
    PACKAGES,
    WEIGHTS,
    Result,
    build_net,
    find_result,
    read_result,
    write_folder,
)
from qs3.inference.predictor import Predictor, load
from qs3.kernels.norms import use_trained
from qs3.models.base import PointClassifier
from qs3.runs.metrics import RunMetrics, read_metrics
from qs3.utils.files import atomic_path, make_folder
from qs3.utils.page import render
from qs3.utils.version import VERSION

EXPORTED = (".onnx", ".pt2")
ALLOWED = 1e-4  # difference of logits
INPUT, OUTPUT = "points", "logits"
_MOST_CLOUDS, _MOST_POINTS = 1 << 16, 1 << 20
_PRIVATE = ("paths.", "hydra.")  # overrides that no other machine needs


def compared(theirs: Float[np.ndarray, "n c"], ours: Float[np.ndarray, "n c"]) -> tuple[bool, str]:
    """Whether two nets' logits of the same clouds agree, and how far they differ.

    Where two neighbours or farthest points are equally far but for their last digits, a net may
    take the other one: so a tenth of the clouds (one of a few) may differ by more than 1e-4.
    """
    difference = np.abs(theirs - ours).max(axis=1)
    typical, odd = np.median(difference), int((~(difference <= ALLOWED)).sum())  # NaN is odd
    words = (
        f"logits on {len(ours)} clouds differ by {typical:.1e} (median) and "
        f"{difference.max():.1e} (largest); {odd} by more than {ALLOWED:g}"
    )
    return bool(typical <= ALLOWED) and odd <= max(1, len(ours) // 10), words


def export_file(ckpt: str | Path, out: Path, packages: Sequence[str] = PACKAGES) -> str:
    """Export the classifier of a run as an .onnx or .pt2 and compare; text for the terminal."""
    predictor = load(ckpt, packages=packages)
    difference = export(predictor, out)
    points = f"{predictor.points}{' (or another number of)' if any_points(predictor) else ''}"
    how = "onnxruntime.InferenceSession" if out.suffix == ".onnx" else "torch.export.load"
    return (
        f"{difference}\n"
        f"saved {out}: {how} reads it; it takes {INPUT!r}, float32 [clouds, points, 3],\n"
        f"any number of prepared clouds of {points} points, and gives {OUTPUT!r} of\n"
        f"{', '.join(predictor.classes)}"
    )


def export_folder(
    ckpt: str | Path, folder: Path, half: bool = False, packages: Sequence[str] = PACKAGES
) -> str:
    """Write a model's folder (see `qs3.inference.model_file`); text for the terminal.

    Args:
        ckpt: what is exported; of an exported folder its card is carried over.
        folder: where to; what lies there of something else stays, and is a ConfigError.
        half: matrices as numbers of 16 bits: half the size, and other probabilities in the fourth
            digit. They count as 32 bits again when the net is built.
        packages: where the net may be defined; the code there is run.
    """
    file, result = find_result(ckpt), read_result(ckpt)
    others = not (folder / WEIGHTS).exists() and any((folder / x).exists() for x in (CARD, CONFIG))
    if others or file.parent.resolve() == folder.resolve():
        raise ConfigError(f"out={folder} holds something else; give another folder")
    if half:  # vectors, of which running variances may be tiny, stay as they are
        weights = {
            name: value.half() if value.is_floating_point() and value.ndim > 1 else value
            for name, value in result.weights.items()
        }
        result = dataclasses.replace(result, weights=weights)
    known = file.with_name(CARD)
    if file.name == WEIGHTS and known.is_file():
        text = known.read_text("utf-8")
    else:
        text = card(result, read_metrics(file.parent), _command(file.parent))
    build_net(result, packages)  # before anything is written
    write_folder(folder, result, text)
    size = (folder / WEIGHTS).stat().st_size / 1e6
    return (
        f"saved {folder}: {WEIGHTS} ({size:.1f} MB), {CONFIG} and {CARD}\n"
        f"qs3.load({str(folder)!r}) and qs3 predict ckpt={folder} read it; read {CARD}, which is "
        "the model's card, before you publish it"
    )


def card(result: Result, metrics: RunMetrics | None, command: str = "") -> str:
    """The model's card as Markdown; without its run's metrics it has no figures.

    The interval of the accuracy is Wilson's at 95 % ("Probable inference", JASA 22, 1927).
    """
    interval = None
    if metrics and metrics.final.accuracy is not None:
        from scipy.stats import binomtest

        right, of = round(metrics.final.accuracy * metrics.final.n), metrics.final.n
        found = binomtest(right, of).proportion_ci(method="wilson")
        interval = (100 * found.low, 100 * found.high)
    return render(
        "card.md",
        net=result.model["_target_"].rpartition(".")[2],
        result=result,
        own=result.own_module,
        metrics=metrics,
        chosen=chosen_in_words(metrics.selection.teacher) if metrics else "",
        interval=interval,
        command=command,
    )


def _command(run: Path) -> str:
    """That trained the run, if it is known; of absolute paths only the last part."""
    path = run / ".hydra" / "overrides.yaml"
    if not path.is_file():
        return ""
    words = [word for word in yaml.safe_load(path.read_text()) if not word.startswith(_PRIVATE)]
    return shlex.join(["qs3-train", *(re.sub(r"=[/~].*/", "=", word) for word in words)])


def export(predictor: Predictor, out: Path, clouds: int = 32) -> str:
    """Write the net to `out`, read it back, and compare it with the net on clouds that are made up.

    Where torch cannot export the net, or the logits differ, it writes no file and raises a
    Qs3Error.
    """
    if out.suffix not in EXPORTED:
        raise ConfigError(f"out={out} must end in {' or '.join(EXPORTED)}, or be a folder")
    points = made_up(predictor.points, clouds)
    # A copy that is not trained: some operations of the graph have no gradients.
    net = copy.deepcopy(predictor.net).cpu().requires_grad_(False).eval()
    # Two, also where there is one: torch takes a size of 1 for one that never changes.
    example = points[:1].repeat(2, 1, 1)
    make_folder(out.parent)
    # What torch compiled for another net's loops, whose sizes would become limits of this one's.
    torch.compiler.reset()
    with _quiet(), torch.no_grad(), use_trained(net, "target"):
        write: Callable[..., Any] = _write_onnx if out.suffix == ".onnx" else _write_pt2
        with atomic_path(out) as temporary:
            try:
                run = write(net, example, predictor, temporary)
            except ImportError as error:
                raise ConfigError(f"{error}: pip install 'qs3[onnx]'") from error
            except Exception as error:  # torch raises dozens of kinds
                cause = error.__cause__ or error
                if isinstance(cause, Qs3Error):  # a net that knows why not
                    raise cause from error
                target, first = predictor.result.model["_target_"], str(cause).strip()[:200]
                raise Qs3Error(f"torch cannot export {target}: {first}") from error
            ours = np.concatenate([net(part).numpy() for part in points.split(16)])
            parts = [points[:1], *points[1:].split(15)]  # the number of clouds must not matter
            theirs = np.concatenate([run(part.contiguous()) for part in parts if len(part)])
            same, words = compared(theirs, ours)
            if not same:
                raise Qs3Error(f"the exported net is not the same: {words}; {out} not written")
    return words


def any_points(predictor: Predictor) -> bool:
    """Whether the exported net takes clouds of any number of points (from some number on)."""
    net = predictor.net
    return isinstance(net, PointClassifier) and predictor.points >= net.backbone.least_points


def made_up(points: int, count: int) -> Float[Tensor, "n m 3"]:
    """Noisy ellipsoids and boxes in the unit ball; every fourth one repeats some of its points."""
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(count, points, 3))
    clouds[::2] /= np.linalg.norm(clouds[::2], axis=2, keepdims=True)
    clouds[1::2] /= np.abs(clouds[1::2]).max(axis=2, keepdims=True)
    clouds = clouds * rng.uniform(0.1, 1, (count, 1, 3)) + rng.normal(scale=0.02, size=clouds.shape)
    some = max(1, 2 * points // 3)
    clouds[::4] = clouds[::4, np.arange(points) % some]
    clouds -= clouds.mean(axis=1, keepdims=True)
    clouds /= np.linalg.norm(clouds, axis=2).max(axis=1)[:, None, None]
    return torch.from_numpy(clouds.astype(np.float32))


def metadata(predictor: Predictor) -> dict[str, str]:
    """What using the net takes besides its weights; stands in the ONNX file's metadata_props."""
    result = predictor.result
    unit = "none: clouds are scaled to the unit ball"
    scaling = ", divide by the largest distance from it"
    if predictor.in_metres:
        unit, scaling = "metre: clouds keep their size", ""
    if predictor.needs_floor:
        scaling = " from x and y, and the floor's height from z"
    return {
        "qs3": VERSION,
        "classes": json.dumps(list(predictor.classes)),
        "points": str(predictor.points),
        "any_number_of_points": str(any_points(predictor)).lower(),
        "up": "z" if result.gravity == "z" else "none (frame of the camera)",
        "target": result.target,
        "unit": unit,
        "stored_points": str(result.stored_points),
        "before": f"farthest point sampling to {result.stored_points} points, from the first one "
        "on; of a smaller cloud all points, repeated from the first one on",
        "normalisation": f"subtract the mean of the points{scaling}",
        "sampling": f"then farthest point sampling to {predictor.points} points, from the first "
        "one on",
        "output": f"{OUTPUT}, before the softmax",
    }


def _shapes(predictor: Predictor) -> tuple[dict[int, Any]]:
    """Which axes of the input are free."""
    net, free = predictor.net, {0: torch.export.Dim("clouds", min=1, max=_MOST_CLOUDS)}
    if any_points(predictor):
        assert isinstance(net, PointClassifier)
        free[1] = torch.export.Dim("points", min=net.backbone.least_points, max=_MOST_POINTS)
    return (free,)


def _write_pt2(
    net: nn.Module, example: Tensor, predictor: Predictor, path: Path
) -> Callable[[Tensor], np.ndarray]:
    """Returns the net as read back."""
    graph = torch.export.export(
        net, (example,), dynamic_shapes=_shapes(predictor), strict=False
    ).run_decompositions({})  # plain operations: nested ones (autocast) cannot be read back
    torch.export.save(graph, path)
    again = torch.export.load(path).module()
    return lambda points: again(points).numpy()


def _write_onnx(
    net: nn.Module, example: Tensor, predictor: Predictor, path: Path
) -> Callable[[Tensor], np.ndarray]:
    """Returns the net as onnxruntime reads and runs it."""
    import onnxruntime  # type: ignore[import-untyped]

    program = torch.onnx.export(
        net,
        (example,),
        dynamo=True,
        dynamic_shapes=_shapes(predictor),
        input_names=[INPUT],
        output_names=[OUTPUT],
        verbose=False,
    )
    assert program is not None
    program.model.metadata_props.update(metadata(predictor))
    program.save(str(path), external_data=False)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(
        path.read_bytes(), options, providers=["CPUExecutionProvider"]
    )
    return lambda points: session.run([OUTPUT], {INPUT: points.numpy()})[0]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without reports for those who write nets; what matters comes as an exception."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(action="ignore"):  # the logits are compared
            yield
    finally:
        logging.disable(before)
