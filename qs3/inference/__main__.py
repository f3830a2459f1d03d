"""What a trained classifier says of your clouds.

    python -m qs3.inference ckpt=RUN input=PATH [out=predictions.csv] [up=z] [batch_size=16]
                          [threads=N] [device=cpu]
    python -m qs3.inference export ckpt=RUN out=model.onnx [check=PATH] [threads=N]

  ckpt=     the folder of a finished run, or its result.pt alone
  input=    a file of clouds, or a folder with any depth of folders: .xyz .txt .npy .npz .ply .pcd
            .h5 .hdf5. Any number of points, any unit, any place; other files are passed over
  up=       the axis that points up in your files: x y z -x -y -z. Which way is up is not guessed,
            and the wrong axis costs most of the accuracy
  out=      .csv or .json; the line at the end says so if it replaced a file
  threads=  batches at the same time, each on one thread; as many as processors if not given
  device=   cpu | cuda | cuda:1

A row for each cloud: file (name[3] is cloud 3 of a file that holds several), status, class,
confidence, points, dropped, out_of_range, reason, and p_<class>, a probability for each class.
Points that are NaN or infinite are left out: dropped counts them, points the others.

out_of_range=yes: a cloud unlike all those of training (fewer points than the net samples and than
training had; spacing, flatness, height or stray points outside what 99.8 % of them had); the reason
says in what. It guarantees nothing:
an object of no known class also gets a class, often with high confidence.

A damaged file gets status=failed and its reason, and the others go on. The exit status is then 1.

export writes the net for use without qs3: out=model.onnx for onnxruntime and others, out=model.pt2
for torch.export.load. It takes prepared clouds [clouds, points, 3] and gives logits; how a cloud is
prepared, and the names of the classes, stand in the .onnx file's metadata. The written net is run
and its logits compared with the net's, on made-up clouds, or on yours (check=, z up; damaged ones
are left out).
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence

from qs3.errors import ConfigError, Qs3Error

_PREDICT = ("ckpt", "input", "out", "up", "batch_size", "threads", "device")
_EXPORT = ("ckpt", "out", "check", "threads")


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    if not argv or argv[0] == "help" or {"-h", "--help"} & set(argv):
        print(__doc__)
        return 0
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        if argv[0] == "export":
            return _export(_options(argv[1:], _EXPORT))
        return _predict(_options(argv, _PREDICT))
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; nothing was saved", file=sys.stderr)
        return 130


def _predict(options: dict[str, str]) -> int:
    from qs3.inference.command import Settings, predict_command

    settings = Settings(
        ckpt=_needed(options, "ckpt"),
        input=_needed(options, "input"),
        out=options.get("out", "predictions.csv"),
        up=options.get("up", "z"),
        batch_size=_whole("batch_size", options.get("batch_size", "16")),
        threads=_threads(options),
        device=options.get("device", "cpu"),
    )
    text, failed = predict_command(settings)
    print(text)
    return 1 if failed else 0


def _export(options: dict[str, str]) -> int:
    from qs3.inference.export import export_command

    ckpt, out = _needed(options, "ckpt"), options.get("out", "model.onnx")
    print(export_command(ckpt, out, options.get("check"), _threads(options)))
    return 0


def _options(argv: Sequence[str], known: Sequence[str]) -> dict[str, str]:
    """key=value words as a dict.

    Raises:
        ConfigError: another key, or no `=`.
    """
    found = {}
    for word in argv:
        key, equals, value = word.partition("=")
        if not equals or key not in known:
            hint = f"; did you mean input={word}?" if not equals and os.path.exists(word) else ""
            raise ConfigError(
                f"unknown argument {word!r}; known are {', '.join(f'{k}=' for k in known)}{hint}"
            )
        found[key] = value
    return found


def _needed(options: dict[str, str], key: str) -> str:
    if not options.get(key):
        raise ConfigError(f"{key}= is missing; see python -m qs3.inference --help")
    return options[key]


def _threads(options: dict[str, str]) -> int:
    return _whole("threads", options.get("threads", str(len(os.sched_getaffinity(0)))))


def _whole(key: str, word: str) -> int:
    if not word.isdecimal() or int(word) < 1:
        raise ConfigError(f"{key} must be a whole number >= 1, got {word!r}")
    return int(word)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
