"""A trained net as one file that needs no qs3: .pt2 for `torch.export.load`, .onnx for runtimes."""

from __future__ import annotations

import copy
import importlib.util
import json
import logging
import re
import shlex
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.config.checks import check_int
from qs3.errors import ConfigError, DataError, Qs3Error
from qs3.inference.judgement import read_judgement
from qs3.inference.model_card import card, carried
from qs3.inference.model_file import (
    EXPORTED,
    PACKAGES,
    build_net,
    find_result,
    own_module,
    read_result,
    values_of,
)
from qs3.inference.model_folder import CARD, CONFIG, WEIGHTS, write_folder
from qs3.inference.predictor import Predictor, load
from qs3.kernels.norms import use_trained
from qs3.models.base import PointClassifier
from qs3.runs.metrics import read_metrics
from qs3.utils.files import atomic_path, make_folder
from qs3.utils.memory import YAML_PEAK, read_whole
from qs3.utils.version import VERSION
from qs3.utils.yamls import load_yaml

ALLOWED = 1e-4  # difference of logits
ALLOWED_ODD = 0.1  # share of clouds that may differ by more, see `Comparison`
SUFFIXES = EXPORTED
INPUT, OUTPUT = "points", "logits"
_CHECKED = 32  # clouds to compare on
_MOST_CLOUDS, _MOST_POINTS = 1 << 16, 1 << 20
_MOST_CARD = 1 << 20  # bytes
_PACKAGES = ("onnx", "onnxscript", "onnxruntime")
_FEATURES = "qs3.models.features.features"  # a head on a file that has no place in a folder


@dataclass(frozen=True)
class Comparison:
    """The exported net's logits and the net's own.

    Sums in another order differ in their last digits. Where two neighbours or farthest points are
    equally far but for these, a net may take the other one, and a cloud's logits differ by more;
    that happens to single clouds, an error to all.

    Attributes:
        clouds: compared.
        typical: the median over the clouds of the largest difference of a cloud's logits.
        largest: the largest of all.
        odd: clouds that differ by more than `ALLOWED`.
    """

    clouds: int
    typical: float
    largest: float
    odd: int

    @classmethod
    def of(cls, theirs: Float[np.ndarray, "n c"], ours: Float[np.ndarray, "n c"]) -> Comparison:
        """Compare two nets' logits of the same n clouds."""
        difference = np.abs(theirs - ours).max(axis=1)
        odd = int((~(difference <= ALLOWED)).sum())  # NaN is odd
        return cls(len(ours), float(np.median(difference)), float(difference.max()), odd)

    @property
    def agrees(self) -> bool:
        """At most a tenth of the clouds differ by more than 1e-4 (one of a few)."""
        return self.typical <= ALLOWED and self.odd <= max(1, int(ALLOWED_ODD * self.clouds))

    def __str__(self) -> str:
        text = (
            f"logits on {self.clouds} clouds differ by {self.typical:.1e} (median) and "
            f"{self.largest:.1e} (largest)"
        )
        if self.odd:
            text += (
                f"; {self.odd} differ by more than {ALLOWED:g}, as where two neighbours are "
                "equally far"
            )
        return text


def export_command(
    ckpt: str | Path,
    out: str | Path,
    threads: int = 1,
    judged: str | Path = "",
    half: bool = False,
    packages: Sequence[str] = (),
) -> str:
    """Export the classifier of a run (or its result.pt) and compare; text for the terminal.

    `judged`, `half` and `packages` as of `export_folder`.
    """
    from qs3.inference.command import saved

    if not Path(out).suffix:
        return export_folder(ckpt, Path(out).expanduser(), judged, half, packages)
    if judged or half:
        raise ConfigError(f"judged= and half= are for a folder; out={out} is a file")
    before = torch.get_num_threads()
    torch.set_num_threads(check_int("threads", threads, 1))
    try:
        predictor = load(ckpt, packages=(*PACKAGES, *packages))
        replaces = Path(out).expanduser().exists()
        compared = export(predictor, out)
    finally:
        torch.set_num_threads(before)  # of the whole process: sums of its next net would differ
    how = f"onnxruntime.InferenceSession({str(out)!r})"
    if Path(out).suffix == ".pt2":
        how = f"torch.export.load({str(out)!r}).module()"
    points = (
        f"{predictor.points} (or another number of)" if any_points(predictor) else predictor.points
    )
    return (
        f"{compared}\n"
        f"{saved(out, replaces)}: {how} takes {INPUT!r}, float32 [clouds, points, 3],\n"
        f"any number of prepared clouds of {points} points, and gives {OUTPUT!r} of\n"
        f"{', '.join(predictor.classes)}; NaN is not noticed"
    )


def export_folder(
    ckpt: str | Path,
    folder: Path,
    judged: str | Path = "",
    half: bool = False,
    packages: Sequence[str] = (),
) -> str:
    """Write a model's folder (see `qs3.inference.model_folder`); text for the terminal.

    Args:
        ckpt: what is exported; of an exported folder its card is carried over.
        folder: where to.
        judged: what `qs3 report judge runs=CKPT out=FILE.json` wrote, for the card; "" for none.
        half: matrices as numbers of 16 bits: half the size, and other probabilities in the fourth
            digit. They count as 32 bits again when the net is built.
        packages: where a net of one's own is defined, beside those of qs3; the code there is run.

    Raises:
        ConfigError: the folder holds a README.md or config.json of something else, or the result;
            or the net needs a file that would not be in it.
        MissingDataError, DataError: no result there, or damaged, or `judged` is not of this run.
    """
    file, result = find_result(ckpt), read_result(ckpt)
    if result.model["_target_"] == _FEATURES:
        raise ConfigError(
            "model=features cannot be exported: a folder would lack its backbone, which is the "
            f"ONNX file {result.model['file']} of yours; others need result.pt, "
            "and that file in the same place"
        )
    judgement = read_judgement(Path(judged).expanduser(), file) if judged else None
    if judgement:
        result = replace(result, worth=judgement.sentence)
    if half:
        result = replace(result, weights=_halved(result.weights))
    if file.parent.resolve() == folder.resolve():
        raise ConfigError(f"out={folder} is where it comes from; give another folder")
    if not (folder / WEIGHTS).exists():
        for name in (CARD, CONFIG):
            if (folder / name).exists():
                raise ConfigError(f"out={folder}: a {name} of something else is there; refused")
    metrics, beside = read_metrics(file.parent), _card_beside(file)
    if metrics is None and beside:
        text = carried(beside, judgement)
    else:
        text = card(result, metrics, _command(file.parent), judgement)
    build_net(result, (*PACKAGES, *packages))  # before anything is written
    write_folder(folder, values_of(result), text)
    again = read_result(folder)
    for name in ("weights", "held_out", "trained_norms"):
        ours, theirs = getattr(result, name) or {}, getattr(again, name) or {}
        if ours.keys() != theirs.keys() or not all(
            torch.equal(one, theirs[key]) for key, one in ours.items()
        ):
            raise Qs3Error(f"{folder} does not hold the {name} as written; is the disk sound?")
    build_net(again, (*PACKAGES, *packages))
    module = own_module(again)
    named = f"; both need packages= and {module}" if module else ""
    return (
        f"saved {folder}: {WEIGHTS} ({(folder / WEIGHTS).stat().st_size / 1e6:.1f} MB), {CONFIG} "
        f"and {CARD}\nqs3.load({str(folder)!r}) and qs3 predict ckpt={folder} read it{named}; read "
        f"{CARD}, which is the model's card, before you publish it"
    )


def _card_beside(file: Path) -> str:
    """The card of a folder that was exported before; "" if there is none, or it is no card."""
    path = file.parent / CARD
    if file.name != WEIGHTS or not path.is_file() or path.stat().st_size > _MOST_CARD:
        return ""
    return path.read_text("utf-8", errors="replace")


def _halved(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Matrices in 16 bits; vectors, of which running variances may be tiny, as they are."""
    return {
        name: value.half() if value.is_floating_point() and value.ndim > 1 else value
        for name, value in weights.items()
    }


def _command(run: Path) -> str:
    """That trained the run, if it is known; of absolute paths only the last part."""
    try:
        path = run / ".hydra" / "overrides.yaml"
        words = load_yaml(read_whole(path, YAML_PEAK).decode(), path)
    except (OSError, ValueError, DataError):
        return ""
    given = [str(word) for word in words] if isinstance(words, list) else []
    kept = [word for word in given if not word.startswith(("paths.", "hydra."))]
    return shlex.join(["qs3-train", *(re.sub(r"=[/~].*/", "=", word) for word in kept)])


def export(
    predictor: Predictor, out: str | Path, clouds: Float[Tensor, "n m 3"] | None = None
) -> Comparison:
    """Write the net to `out`, read it back, and compare it with the net, one cloud and many.

    `clouds`: prepared ones to compare on; None makes some up.

    Raises:
        ConfigError: another kind of file, or a package for it is missing.
        Qs3Error: torch cannot export this net, or the logits differ: then there is no file.
    """
    out = Path(out).expanduser()
    if out.suffix not in SUFFIXES:
        raise ConfigError(
            f"out={out} must end in {' or '.join(SUFFIXES)}, or be a folder without a dot in its "
            "name"
        )
    if out.suffix == ".onnx":
        check_packages()
    clouds = made_up(predictor.points) if clouds is None else clouds
    # A copy that nobody trains: some operations of the graph have no gradients.
    net = copy.deepcopy(predictor.net).cpu().requires_grad_(False).eval()
    # Two, also where there is one: torch takes a size of 1 for one that never changes.
    example = clouds[:1].repeat(2, 1, 1)
    make_folder(out.parent)
    # What torch compiled for another net's loops, whose sizes would become limits of this one's.
    torch.compiler.reset()
    with _quiet(), torch.no_grad(), use_trained(net, "target"):
        write: Callable[..., Any] = _write_onnx if out.suffix == ".onnx" else _write_pt2
        with atomic_path(out) as temporary:
            try:
                run = write(net, example, predictor, temporary)
            except Exception as error:  # torch raises dozens of kinds
                raise _cannot(predictor, error) from error
            ours = np.concatenate([net(part).numpy() for part in clouds.split(16)])
            parts = [clouds[:1], *clouds[1:].split(15)]  # the number of clouds must not matter
            theirs = np.concatenate([run(part.contiguous()) for part in parts if len(part)])
            compared = Comparison.of(theirs, ours)
            if not compared.agrees:
                raise Qs3Error(f"the exported net is not the same: {compared}; {out} not written")
    return compared


def any_points(predictor: Predictor) -> bool:
    """Whether the exported net takes clouds of any number of points (from some number on)."""
    net = predictor.net
    return isinstance(net, PointClassifier) and predictor.points >= net.backbone.least_points


def made_up(points: int, count: int = _CHECKED) -> Float[Tensor, "n m 3"]:
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
    upright = result.gravity == "z"
    unit, scaling = (
        "none: clouds are scaled to the unit ball",
        ", divide by the largest distance from it",
    )
    if predictor.in_metres:
        unit, scaling = "metre: clouds keep their size", ""
    if predictor.needs_floor:
        scaling = " from x and y, and the floor's height from z"
    return {
        "qs3": VERSION,
        "classes": json.dumps(list(predictor.classes)),
        "points": str(predictor.points),
        "any_number_of_points": str(any_points(predictor)).lower(),
        "up": "z" if upright else "none (frame of the camera)",
        "target": result.target,
        "unit": unit,
        "stored_points": str(result.stored_points),
        "before": f"farthest point sampling to {result.stored_points} points, from the first one "
        "on; of a smaller cloud all points, repeated from the first one on",
        "normalisation": f"subtract the mean of the points{scaling}",
        "sampling": f"then farthest point sampling to {predictor.points} points, from the first "
        "one on",
        "input": f"{INPUT}: float32 [clouds, points, 3]",
        "output": f"{OUTPUT}: float32 [clouds, {len(predictor.classes)}], before the softmax",
    }


def check_packages() -> None:
    """Raise ConfigError if a package that writes or checks ONNX files is not installed."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"an .onnx file needs {', '.join(missing)}, not installed here: "
            "pip install '.[onnx]' in the folder of qs3; out=model.pt2 needs torch alone"
        )


def _shapes(predictor: Predictor) -> tuple[dict[int, Any]]:
    """Which axes of the input are free."""
    free: dict[int, Any] = {0: torch.export.Dim("clouds", min=1, max=_MOST_CLOUDS)}
    if any_points(predictor):
        net: Any = predictor.net
        least = net.backbone.least_points
        free[1] = torch.export.Dim("points", min=least, max=_MOST_POINTS)
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


def _cannot(predictor: Predictor, error: Exception) -> Qs3Error:
    cause = error.__cause__ or error
    if isinstance(cause, Qs3Error):  # a net that says itself why not
        return cause
    first = next((line for line in f"{cause}\n{error}".splitlines() if line.strip()), "")
    return Qs3Error(
        f"torch {torch.__version__} cannot export {predictor.result.model['_target_']}: its layers "
        "do what a graph cannot hold, mostly work that depends on values or on the number of "
        f"clouds ({type(cause).__name__}: {first[:200]}); use it by qs3.load"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Without reports for those who write nets; what matters comes as an exception."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            # A warning about tensors that share memory; the logits are compared after reading back.
            warnings.filterwarnings("ignore", message="No complete tensor found")
            # torch 2.13 asks its own tree of arguments in an old way, when it copies it.
            warnings.filterwarnings("ignore", message=".*LeafSpec", category=FutureWarning)
            yield
    finally:
        logging.disable(before)
