"""Frozen features of a foundation net in an ONNX file, and a head that is trained on them.

For nets such as Uni3D, OpenShape or ULIP-2, through a file of the user's own: [B, N, 3] float32
clouds to [B, D] features. An ONNX file holds a graph of known operations and numbers, no code: it
is run by onnxruntime from the bytes whose SHA-256 is in the run's config, and files next to it that
it names are not read. Features of a run's clouds are computed once (`remember`) and kept on disk,
under the hash of the file and of the clouds; any other cloud is computed when it comes.
"""

from __future__ import annotations

import functools
import hashlib
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.datamodules.clouds import Clouds
from qs3.datamodules.fps_samples import keep_array, read_array
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.kernels.device import exporting
from qs3.models.base import Backbone, Features, PointClassifier, with_head
from qs3.utils.settings import checked

log = logging.getLogger(__name__)

_BATCH = 32  # clouds at once: always the same ones together, so that a resume has the same bits
_PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")


class Encoder:
    """The net in an ONNX file, and the features that are known.

    Attributes:
        dim: D.
        known: features [D] by the SHA-256 of a cloud's bytes.
    """

    def __init__(self, data: bytes, sha256: str, where: str) -> None:
        import onnx
        import onnxruntime  # type: ignore[import-untyped]
        from onnx.external_data_helper import _get_all_tensors, uses_external_data

        self.sha256, self.where = sha256, where
        self.known: dict[bytes, Float[np.ndarray, " d"]] = {}
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # what it has to say is in the error
        options.intra_op_num_threads = torch.get_num_threads()
        there = onnxruntime.get_available_providers()
        try:
            model = onnx.load_model_from_string(data)
            beside = any(map(uses_external_data, _get_all_tensors(model)))
            assert not beside, "weights lie in files next to it: export it as one file"
            self.session = onnxruntime.InferenceSession(
                data, options, providers=[name for name in _PROVIDERS if name in there]
            )
            (points,), (features,) = self.session.get_inputs(), self.session.get_outputs()
            self.name, self.dim = points.name, int(features.shape[-1])
        except Exception as error:  # of protobuf and pybind, with classes of their own
            raise DataError(f"{where} is not an ONNX net [B, N, 3] to [B, D]: {error}") from error

    def __deepcopy__(self, memo: Any) -> Encoder:
        """Copies of a net share it: nothing in it is trained."""
        return self

    def __call__(self, points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b d"]:
        """Features, of known clouds without computing them.

        Raises:
            DataError: the file's net does not give finite float32 [B, D].
        """
        found = [self.known.get(digest) for digest in map(_digest, points)]
        new = [i for i, one in enumerate(found) if one is None]
        if new:
            for i, one in zip(new, self.compute(points[new]), strict=True):
                found[i] = one
        return np.stack(found)  # type: ignore[arg-type]

    def compute(self, points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b d"]:
        """Features by the net itself; see `__call__`."""
        (found,) = self.session.run(None, {self.name: np.ascontiguousarray(points)})
        expected = (len(points), self.dim)
        if found.shape != expected or found.dtype != np.float32 or not np.isfinite(found).all():
            raise DataError(f"{self.where} gave other than finite float32 {list(expected)}")
        return np.asarray(found)

    def remember(self, clouds: Clouds, folder: Path | None) -> None:
        """Know the features of these clouds in all samples, from `folder` if they are there."""
        points = [
            clouds.take(index, torch.full_like(index, start)).numpy()
            for start in range(clouds.starts)
            for index in torch.arange(len(clouds)).split(_BATCH)
        ]
        digests = [digest for batch in points for digest in map(_digest, batch)]
        data = hashlib.sha256(b"".join(digests)).hexdigest()
        name, shape = f"features {self.sha256} {data}", (len(digests), self.dim)

        def work() -> Float[np.ndarray, "n d"]:
            log.info("features of %d clouds by %s", len(digests), self.where)
            return np.concatenate([self.compute(batch) for batch in points])

        if folder is None:
            found = work()
        else:
            path = folder / "features" / f"{self.sha256[:16]}-{data[:16]}.npy"
            kept = read_array(path, shape, name)
            found = keep_array(path, work(), name) if kept is None else kept
        self.known.update(zip(digests, np.array(found), strict=True))


class Frozen(Backbone):
    """A backbone that is not trained and has no weights of its own: they stay in their file."""

    def __init__(self, encoder: Encoder) -> None:
        super().__init__()
        self.encoder, self.feature_dim = encoder, encoder.dim

    def forward(self, points: Float[Tensor, "b n 3"]) -> Features:
        """[B, N, 3] to the file's features; no gradient goes back to the points."""
        if exporting():
            raise ConfigError("model=features cannot be exported: its backbone is an ONNX file")
        found = self.encoder(points.detach().cpu().to(torch.float32).numpy())
        return Features(torch.from_numpy(found).to(points), None)


@checked
def features(
    num_classes: int,
    file: str,
    sha256: str,
    hidden: Sequence[int] = (256,),
    dropout: float = 0.5,
    norm: Literal["batch", "domain"] = "batch",
) -> PointClassifier:
    """A head on the features that the net of an ONNX file gives; no file next to it is read.

    `sha256` is that of its content, in 64 hex digits. With no `hidden` widths the head is a linear
    probe; its `norm` is not "instance", which one vector a cloud does not have.

    Raises:
        MissingDataError: the file is not there.
        DataError: it is another one than that of this hash, damaged, or not such a net.
    """
    backbone = Frozen(_encoder(file, sha256))
    return with_head(backbone, num_classes, hidden=tuple(hidden), dropout=dropout, norm=norm)


def remember(net: nn.Module, of: Iterable[Clouds], folder: Path | None) -> None:
    """Compute what a net of `features` will be asked for, or read it; of other nets nothing."""
    for module in net.modules():
        if isinstance(module, Frozen):
            for clouds in of:
                module.encoder.remember(clouds, folder)


@functools.lru_cache(maxsize=2)
def _encoder(file: str, sha256: str) -> Encoder:
    """One for all nets of a process: it is large, and what is known is known to all."""
    try:
        data = Path(file).expanduser().read_bytes()
    except OSError as error:
        raise MissingDataError(f"model.file={file} cannot be read ({error})") from error
    if hashlib.sha256(data).hexdigest() != sha256:
        raise DataError(f"model.file={file} is not the file of SHA-256 {sha256[:12]}")
    return Encoder(data, sha256, f"model.file={file}")


def _digest(cloud: Float[np.ndarray, "n 3"]) -> bytes:
    return hashlib.sha256(cloud.tobytes()).digest()
