"""Files in, a table out: read, prepare, predict in batches, save."""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from qs3.clouds.files import SUFFIXES, measured, parse_clouds, printable
from qs3.config.checks import check_choice, check_int
from qs3.data.importers.folders import UP_AXES
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.inference.model_file import PACKAGES
from qs3.inference.predictor import Predictor, Prepared, load
from qs3.models.norms import norms_for, use_domain
from qs3.utils.files import make_folder, write_text
from qs3.utils.progress import progress_bar
from qs3.utils.version import VERSION

_SHOWN = 10  # failures in the text for the terminal


@dataclass(frozen=True)
class Settings:
    """Of one call.

    Attributes:
        ckpt: a run's folder or result.pt.
        input: a file or folder.
        out: .csv or .json.
        up: the axis that points up in the files.
        batch_size: clouds that the net sees at a time.
        threads: batches that are worked on at the same time.
        device: of the net.
    """

    ckpt: str
    input: str
    out: str = "predictions.csv"
    up: str = "z"
    batch_size: int = 16
    threads: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        check_choice("up", self.up, UP_AXES)
        check_int("batch_size", self.batch_size, 1)
        check_int("threads", self.threads, 1)
        if Path(self.out).suffix.lower() not in (".csv", ".json"):
            raise ConfigError(f"out={self.out} must end in .csv or .json")


class Row(NamedTuple):
    """What is said of one cloud, or why nothing can be said.

    Attributes:
        file: relative to the input; name[3] is cloud 3 of a file that holds several.
        points: in the file, without those dropped; None if it could not be read.
        dropped: points of the file that are NaN or infinite; None if it could not be read.
        reason: in what it is out of range, or why it failed; "" otherwise.
        probabilities: [C] float64; None if it failed.
    """

    file: str
    points: int | None
    dropped: int | None
    reason: str
    probabilities: np.ndarray | None


def predict_command(
    settings: Settings, packages: Sequence[str] = PACKAGES
) -> tuple[str, list[Row]]:
    """Predict and save.

    Returns:
        The text for the terminal, and the rows that failed.

    Raises:
        ConfigError, MissingDataError, DataError: nothing could be done at all.
    """
    files, root, others = find_files(settings.input)
    predictor = load(settings.ckpt, device=settings.device, packages=packages)
    out = Path(settings.out).expanduser()
    make_folder(out.parent)
    replaces = out.exists()
    began = time.monotonic()
    with progress_bar("files read", total=len(files)) as advance:
        rows = list(predict_files(predictor, files, root, settings, advance))
    seconds = time.monotonic() - began
    written = _json if out.suffix.lower() == ".json" else _csv
    write_text(out, written(rows, predictor))
    failed = [row for row in rows if row.probabilities is None]
    lines = _told(rows, failed, len(files), others, predictor, seconds)
    return "\n".join([*lines, saved(out, replaces)]), failed


def saved(out: str | Path, replaces: bool) -> str:
    """Says where a file lies now, and that another one lay there."""
    return f"saved {out}" + " (replaced what was there)" * replaces


def find_files(place: str | Path, key: str = "input") -> tuple[list[Path], Path, int]:
    """The files to read, what their names are relative to, and how many files are passed over.

    In a folder: all files of known formats at any depth, in order of their names; hidden ones and
    links to folders are left out.

    Args:
        place: a file or folder.
        key: of the command line that names it, for messages.

    Raises:
        MissingDataError: nothing there.
        DataError: one file, of an unknown format.
    """
    place = Path(place).expanduser()
    if place.is_file():
        if place.suffix.lower() not in SUFFIXES:
            raise DataError(f"{key}={place}: unknown format; known are {', '.join(SUFFIXES)}")
        return [place], place.parent, 0
    if not place.is_dir():
        raise MissingDataError(f"{key}={place} is not there")
    found, others = [], 0
    for folder, folders, names in os.walk(place):
        folders[:] = sorted(f for f in folders if not f.startswith(".") and f != "__MACOSX")
        for name in sorted(names):
            if name.startswith("."):
                continue
            if os.path.splitext(name)[1].lower() in SUFFIXES:
                found.append(Path(folder) / name)
            else:
                others += 1
    if not found:
        raise MissingDataError(f"{key}={place} holds no file of {' '.join(SUFFIXES)}")
    return sorted(found), place, others


def predict_files(
    predictor: Predictor,
    files: Iterable[Path],
    root: Path,
    settings: Settings,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[Row]:
    """A row for each cloud, in order.

    Each of `settings.threads` threads has a batch of its own: the work between products of
    matrices does not gain from several threads in one batch. A few batches are in memory.

    Args:
        predictor: the classifier.
        files: to read.
        root: folder that names are relative to.
        settings: up, batch_size and threads.
        advance: called after each file.
    """
    threads_before = torch.get_num_threads()
    pool = ThreadPoolExecutor(settings.threads, initializer=torch.set_num_threads, initargs=(1,))
    running: deque[Future[list[Row]]] = deque()
    net = predictor.net
    try:
        # Once for all: threads that change and restore a net's domain would do it to one another.
        with use_domain(net, norms_for(net, "target")):
            for batch in _batches(files, root, settings.batch_size, advance):
                running.append(pool.submit(_judged, predictor, batch, settings.up))
                if len(running) > 2 * settings.threads:
                    yield from running.popleft().result()
            while running:
                yield from running.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads_before)  # libraries below torch keep one number for all


class _Raw(NamedTuple):
    """A cloud as read: its name in the table, its points, and how many were not finite."""

    name: str
    cloud: np.ndarray
    dropped: int


def _batches(
    files: Iterable[Path], root: Path, size: int, advance: Callable[[], None]
) -> Iterator[list[Row | _Raw]]:
    """The clouds of all files, `size` at a time; what cannot be read is a row already."""
    batch: list[Row | _Raw] = []
    for path in files:
        for item in _read(path, root):
            batch.append(item)
            if len(batch) == size:
                yield batch
                batch = []
        advance()
    if batch:
        yield batch


def _read(path: Path, root: Path) -> Iterator[Row | _Raw]:
    name = _printable(path.relative_to(root).as_posix())
    try:
        found = parse_clouds(path)
    except DataError as error:
        yield Row(name, None, None, _reason(error, str(path)), None)
        return
    for i, given in enumerate(found.clouds):
        own = f"{name}[{i}]" if found.many else name
        try:
            cloud, dropped = measured(given, own)
        except DataError as error:
            yield Row(own, 0, len(given), _reason(error, own), None)
            continue
        yield _Raw(own, cloud, dropped)


def _reason(error: DataError, name: str) -> str:
    """What is wrong, without the name before it: that has a column of its own."""
    return printable(str(error).removeprefix(name).lstrip(" :,"))


def _judged(predictor: Predictor, batch: Sequence[Row | _Raw], up: str) -> list[Row]:
    """The rows of a batch: each cloud prepared, and one pass of the net."""
    prepared: dict[int, tuple[_Raw, Prepared]] = {}
    rows: dict[int, Row] = {}
    for i, item in enumerate(batch):
        if isinstance(item, Row):
            rows[i] = item
            continue
        try:
            prepared[i] = item, predictor.prepare(item.cloud, item.name, up)
        except DataError as error:
            why = _reason(error, item.name)
            rows[i] = Row(item.name, len(item.cloud), item.dropped, why, None)
    if prepared:
        points = torch.stack([each.points for _, each in prepared.values()])
        found = predictor.probabilities(points, len(points))
        for (i, (item, each)), probabilities in zip(prepared.items(), found, strict=True):
            why = "; ".join(each.strange)
            rows[i] = Row(item.name, each.given, item.dropped, why, probabilities)
    return [rows[i] for i in range(len(batch))]


def _csv(rows: list[Row], predictor: Predictor) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    first = ("file", "status", "class", "confidence", "points", "dropped")
    writer.writerow(
        [*first, "out_of_range", "reason", *(f"p_{name}" for name in predictor.classes)]
    )
    for row in rows:
        values = _record(row, predictor)
        each = values.pop("probabilities") or dict.fromkeys(predictor.classes)
        flag = {True: "yes", False: "no", None: None}[values["out_of_range"]]
        cells = {**values, "out_of_range": flag}.values()
        writer.writerow(["" if cell is None else cell for cell in (*cells, *each.values())])
    return text.getvalue()


def _json(rows: list[Row], predictor: Predictor) -> str:
    record = {
        "qs3": VERSION,
        "target": predictor.result.target,
        "classes": list(predictor.classes),
        "clouds": [_record(row, predictor) for row in rows],
    }
    return json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _record(row: Row, predictor: Predictor) -> dict[str, Any]:
    if row.probabilities is None:
        nothing = dict.fromkeys(("class", "confidence"))
        return {
            **{"file": row.file, "status": "failed", **nothing},
            **{"points": row.points, "dropped": row.dropped},
            **{"out_of_range": None, "reason": row.reason, "probabilities": None},
        }
    each = row.probabilities.tolist()
    best = int(row.probabilities.argmax())
    return {
        "file": row.file,
        "status": "ok",
        "class": predictor.classes[best],
        "confidence": each[best],
        "points": row.points,
        "dropped": row.dropped,
        "out_of_range": bool(row.reason),
        "reason": row.reason,
        "probabilities": dict(zip(predictor.classes, each, strict=True)),
    }


def _told(
    rows: list[Row],
    failed: list[Row],
    files: int,
    others: int,
    predictor: Predictor,
    seconds: float,
) -> list[str]:
    """What was done, for the terminal."""
    good = [row for row in rows if row.probabilities is not None]
    strange = sum(bool(row.reason) for row in good)
    counts = Counter(
        predictor.classes[int(row.probabilities.argmax())]
        for row in good
        if row.probabilities is not None
    )
    rate = len(good) / max(seconds, 1e-9)
    lines = [f"{len(good)} clouds, {rate:.1f} clouds a second, from {files} files"]
    if good:
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        lines.append(f"{strange} of them out of range (column out_of_range)")
    if holed := [row for row in good if row.dropped]:
        dropped = sum(row.dropped or 0 for row in holed)
        lines.append(
            f"{dropped} points of {len(holed)} clouds are NaN or infinite and were left out "
            "(column dropped)"
        )
    if predictor.result.gravity == "none":
        lines.append("the classifier was trained on clouds in the frame of their camera, not z up")
    if others:
        lines.append(f"{others} files of other kinds passed over")
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {row.file}: {row.reason}" for row in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines


def _printable(name: str) -> str:
    """A file's name as UTF-8; bytes that are none become escapes."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
