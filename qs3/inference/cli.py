"""`qs3 predict` and `qs3 export`."""

from __future__ import annotations

import os
from typing import Any

from qs3.utils.cli import Command, Option, text, whole

_CKPT = Option("ckpt", text("RUN"), "a finished run's folder, or its result.pt", required=True)
_THREADS = Option("threads", whole(), "batches at the same time (default: one a processor)")


def _predict(threads: int | None, **given: Any) -> int:
    from qs3.inference.command import Settings, predict_command

    said, failed = predict_command(Settings(threads=threads or _processors(), **given))
    print(said)
    return 1 if failed else 0


def _export(ckpt: str, out: str, threads: int | None) -> None:
    from qs3.inference.export import export_command

    print(export_command(ckpt, out, threads or _processors()))


def _processors() -> int:
    return len(os.sched_getaffinity(0))


PREDICT = Command(
    "qs3 predict",
    "what a trained classifier says of your clouds",
    _predict,
    (
        _CKPT,
        Option("input", text("PATH"), "a file of clouds, or a folder of them", required=True),
        Option("out", text("FILE"), ".csv or .json", "predictions.csv"),
        Option("up", text("AXIS"), "which points up in your files: x y z -x -y -z", "z"),
        Option("batch_size", whole(), "clouds that the net sees at a time", 16),
        _THREADS,
        Option("device", text("DEVICE"), "cpu, cuda or cuda:1", "cpu"),
    ),
    (
        "qs3 predict ckpt=logs/own_scans/seed0-5f0c2a71 input=scans",
        "qs3 predict ckpt=result.pt input=scans out=predictions.json up=y device=cuda",
    ),
    about="""
Clouds are .xyz .txt .npy .npz .ply .pcd .h5 .hdf5, in any depth of folders: any number of points,
any unit, any place. Other files are passed over. Which way is up is not guessed, and the wrong axis
costs most of the accuracy.

A row for each cloud: file (name[3] is cloud 3 of a file that holds several), status, class,
confidence, points, dropped, out_of_range, reason, and p_<class>, a probability for each class.
Points that are NaN or infinite are left out: dropped counts them, points the others.

out_of_range=yes: a cloud unlike all those of training (fewer points than the net samples and than
training had; spacing, flatness, height or stray points outside what 99.8 % of them had); the reason
says in what. It guarantees nothing: an object of no known class also gets a class, often with high
confidence.

A damaged file gets status=failed and its reason, and the others go on. The exit status is then 1.
""",
    interrupted="nothing was saved",
)

EXPORT = Command(
    "qs3 export",
    "a trained net for use without qs3, in ONNX or by torch.export",
    _export,
    (
        _CKPT,
        Option("out", text("FILE"), ".onnx, or .pt2 for torch.export.load", "model.onnx"),
        _THREADS,
    ),
    (
        "qs3 export ckpt=logs/own_scans/seed0-5f0c2a71 out=model.onnx",
        "qs3 export ckpt=result.pt out=model.pt2",
    ),
    about="""
It takes prepared clouds [clouds, points, 3] and gives logits; how a cloud is prepared, and the
names of the classes, stand in the .onnx file's metadata. The written net is run on made-up clouds
and its logits compared with the net's.
""",
    interrupted="nothing was saved",
)
