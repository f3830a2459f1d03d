"""Files in, a table out: read, prepare, predict in batches, save."""

from __future__ import annotations

import json
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from qs3.clouds.files import SUFFIXES, measured, parse_clouds, printable
from qs3.config.checks import check_choice
from qs3.data.importers.folders import UP_AXES
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.inference.predictor import Predictor, Prepared, load
from qs3.models.norms import norms_for, use_domain
from qs3.utils.files import make_folder, write_text
from qs3.utils.progress import progress_bar
from qs3.utils.text_table import csv_text
from qs3.utils.version import VERSION

_SHOWN = 10  # failures in the text for the terminal
_COLUMNS = (
    *("file", "status", "class", "confidence", "points", "dropped"),
    *("out_of_range", "reason"),
)


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


def predict_command(settings: Settings) -> tuple[str, int]:
    """Predict and save.

    Returns:
        The text for the terminal, and how many clouds failed.

    Raises:
        ConfigError, MissingDataError, DataError: nothing could be done at all.
    """
    files, root, others = find_files(settings.input)
    predictor = load(settings.ckpt, device=settings.device)
    out = Path(settings.out).expanduser()
    make_folder(out.parent)
    replaces = out.exists()
    began = time.monotonic()
    with progress_bar("files read", total=len(files)) as advance:
        rows = list(predict_files(predictor, files, root, settings, advance))
    seconds, classes = time.monotonic() - began, predictor.classes
    records = [_record(row, classes) for row in rows]
    as_json = out.suffix.lower() == ".json"
    write_text(out, _json(records, predictor) if as_json else _csv(records, classes))
    lines = _told(records, len(files), others, predictor.result.gravity, seconds)
    failed = sum(row.probabilities is None for row in rows)
    return "\n".join([*lines, saved(out, replaces)]), failed


def saved(out: str | Path, replaces: bool) -> str:
    """Says where a file lies now, and that another one lay there."""
    return f"saved {out}" + " (replaced what was there)" * replaces


def find_files(place: str | Path) -> tuple[list[Path], Path, int]:
    """The files to read, what their names are relative to, and how many files are passed over.

    In a folder: all files of known formats at any depth, in order of their names; hidden ones and
    links to folders are left out.

    Raises:
        MissingDataError: nothing there.
        DataError: one file, of an unknown format.
    """
    place = Path(place).expanduser()
    if place.is_file():
        if place.suffix.lower() not in SUFFIXES:
            raise DataError(f"input={place}: unknown format; known are {', '.join(SUFFIXES)}")
        return [place], place.parent, 0
    if not place.is_dir():
        raise MissingDataError(f"input={place} is not there")
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
        raise MissingDataError(f"input={place} holds no file of {' '.join(SUFFIXES)}")
    return sorted(found), place, others


def predict_files(
    predictor: Predictor,
    files: Iterable[Path],
    root: Path,
    settings: Settings,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[Row]:
    """A row for each cloud, in order, named relative to `root`; `advance` is called after a file.

    Each of `settings.threads` threads has a batch of its own: the work between products of
    matrices does not gain from several threads in one batch. A few batches are in memory.
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


def _record(row: Row, classes: Sequence[str]) -> dict[str, Any]:
    """What both formats say of a cloud; None where there is nothing to say."""
    record: dict[str, Any] = {
        **dict.fromkeys(_COLUMNS),
        "file": row.file,
        "status": "failed",
        "points": row.points,
        "dropped": row.dropped,
        "reason": row.reason,
        "probabilities": None,
    }
    if row.probabilities is not None:
        best, each = int(row.probabilities.argmax()), row.probabilities.tolist()
        record |= {
            "status": "ok",
            "class": classes[best],
            "confidence": each[best],
            "out_of_range": bool(row.reason),
            "probabilities": dict(zip(classes, each, strict=True)),
        }
    return record


def _csv(records: Sequence[Mapping[str, Any]], classes: Sequence[str]) -> str:
    lines: list[list[Any]] = [[*_COLUMNS, *(f"p_{name}" for name in classes)]]
    for record in records:
        flag = {True: "yes", False: "no", None: None}[record["out_of_range"]]
        cells = {**record, "out_of_range": flag}
        each = record["probabilities"] or dict.fromkeys(classes)
        lines.append([*(cells[key] for key in _COLUMNS), *each.values()])
    return csv_text(lines)


def _json(records: Sequence[Mapping[str, Any]], predictor: Predictor) -> str:
    document = {
        "qs3": VERSION,
        "target": predictor.result.target,
        "classes": list(predictor.classes),
        "clouds": records,
    }
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _told(
    records: Sequence[Mapping[str, Any]], files: int, others: int, gravity: str, seconds: float
) -> list[str]:
    """What was done, for the terminal."""
    good = [record for record in records if record["status"] == "ok"]
    failed = [record for record in records if record["status"] == "failed"]
    counts = Counter(record["class"] for record in good)
    rate = len(good) / max(seconds, 1e-9)
    lines = [f"{len(good)} clouds, {rate:.1f} clouds a second, from {files} files"]
    if good:
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        strange = sum(record["out_of_range"] for record in good)
        lines.append(f"{strange} of them out of range (column out_of_range)")
    if holed := [record["dropped"] for record in good if record["dropped"]]:
        lines.append(
            f"{sum(holed)} points of {len(holed)} clouds are NaN or infinite and were left out "
            "(column dropped)"
        )
    if gravity == "none":
        lines.append("the classifier was trained on clouds in the frame of their camera, not z up")
    if others:
        lines.append(f"{others} files of other kinds passed over")
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {record['file']}: {record['reason']}" for record in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines


def _printable(name: str) -> str:
    """A file's name as UTF-8; bytes that are none become escapes."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
