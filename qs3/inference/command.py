"""Clouds or depth images in, a table and a page out: read, prepare, predict in batches, save."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from qs3.config.checks import check_choice, check_float
from qs3.data.frames.pointed import LEVEL, PLANES
from qs3.data.importers.folders import UP_AXES
from qs3.errors import ConfigError, DataError
from qs3.inference.depth_list import Shown, direction, find_shown, numbers
from qs3.inference.inputs import (
    Sample,
    Unit,
    archive_units,
    cloud_units,
    depth_units,
    find_files,
    is_archive,
    reason_of,
)
from qs3.inference.model_file import find_result
from qs3.inference.page import Gallery, page
from qs3.inference.predictor import Predictor, Prepared, load
from qs3.inference.scores import Count, scores
from qs3.inference.table import Row, as_csv, as_json, record
from qs3.models.norms import norms_for, use_domain
from qs3.runs.metrics import read_metrics
from qs3.utils.files import make_folder, write_text
from qs3.utils.progress import progress_bar

_SHOWN = 10  # failures in the text for the terminal


@dataclass(frozen=True)
class Settings:
    """Settings of one call.

    Attributes:
        ckpt: a run's folder or result.pt.
        input: a file or folder of clouds, or an archive of cut objects; "" if `depth` is given.
        depth: a depth image, a folder or list of them; "" if `input` is given.
        mask, box, intrinsics: of depth images; see `qs3.inference.depth_list`.
        depth_scale: metres a unit; None: by the kind of numbers.
        up: the axis that points up in clouds (z if ""), or a direction in the depth camera's frame.
        floor: where the floor is in clouds along that axis, in metres; None: not known.
        camera_height: of the depth images' camera above the floor, in metres; likewise.
        part: of an archive; "" for what one chooses on, "all" for all: see `archive_units`.
        sample: so many of the files, images or objects, drawn at random; None: all.
        out: .csv or .json.
        page: also write a page beside it.
        batch_size: clouds that the net sees at a time.
        threads: batches that are worked on at the same time.
        device: of the net.
    """

    ckpt: str
    input: str = ""
    depth: str = ""
    mask: str = ""
    box: str = ""
    intrinsics: str = ""
    depth_scale: float | None = None
    up: str = ""
    floor: float | None = None
    camera_height: float | None = None
    part: str = ""
    sample: int | None = None
    out: str = "predictions.csv"
    page: bool = True
    batch_size: int = 16
    threads: int = 1
    device: str = "cpu"

    def __post_init__(self) -> None:
        if bool(self.input) == bool(self.depth):
            raise ConfigError("give input=PATH for clouds, or depth=PATH for depth images")
        of_depth = {"mask", "box", "intrinsics", "depth_scale", "camera_height"}
        if odd := [key for key in sorted(of_depth) if getattr(self, key) and not self.depth]:
            raise ConfigError(f"{odd[0]}= is for depth images; give depth=IMAGE, not input=")
        if self.depth_scale is not None and not 0 < self.depth_scale <= 1:
            raise ConfigError(f"depth_scale={self.depth_scale:g}: metres a unit, in (0, 1]")
        if self.depth and self.floor is not None:
            raise ConfigError("floor= is for clouds; of depth images give camera_height=METRES")
        if self.camera_height is not None:
            check_float("camera_height", self.camera_height, ">= 0")
        if self.input:
            check_choice("up", self.up or "z", UP_AXES)
        if Path(self.out).suffix.lower() not in (".csv", ".json"):
            raise ConfigError(f"out={self.out} must end in .csv or .json")


class Inputs(NamedTuple):
    """What there is to read, how many files are passed over, and what a unit is called.

    `part` says which part of an archive they are, if it has parts.
    """

    units: Sequence[Unit]
    others: int
    kind: str
    part: str = ""


def predict_command(settings: Settings) -> tuple[str, int]:
    """Predict and save.

    Returns:
        The text for the terminal, and how many clouds failed.

    Raises:
        ConfigError, MissingDataError, DataError: nothing could be done at all.
    """
    find = _depth_images(settings) if settings.depth else _clouds(settings)
    predictor = load(settings.ckpt, device=settings.device)
    classes = predictor.classes
    inputs = find(predictor)
    if predictor.needs_floor and inputs.kind == "files" and settings.floor is None:
        raise ConfigError(
            "the classifier knows heights above the floor, and nothing in these clouds tells where "
            "it is: give floor=Z, 0 if objects stand on z = 0, minus the camera's height if the "
            "camera is the origin"
        )
    if settings.sample and settings.sample < len(inputs.units):
        drawn = np.random.default_rng(0).choice(len(inputs.units), settings.sample, replace=False)
        inputs = inputs._replace(units=[inputs.units[i] for i in sorted(drawn)])
    if _camera_is_missing(predictor, settings):
        key = "camera_height=METRES" if settings.depth else "floor=-METRES"
        raise ConfigError(
            "the classifier knows heights above the floor, and its target's clouds say nothing "
            f"about a camera: give its height, {key}"
        )
    out = Path(settings.out).expanduser()
    make_folder(out.parent)
    began, gallery, rows = time.monotonic(), Gallery(classes), []
    with progress_bar(f"{inputs.kind} read", total=len(inputs.units)) as advance:
        for row, sample in predict_units(predictor, inputs.units, settings, advance):
            rows.append(row)
            if sample and settings.page:
                gallery.add(row, sample)
    seconds = time.monotonic() - began
    records = [record(row, classes) for row in rows]
    trained_on = _trained_on(settings.ckpt)
    lines = _told(rows, records, inputs, predictor, settings, seconds)
    lines += [f"the classifier's data: {trained_on}"] * bool(trained_on)
    if out.suffix.lower() == ".json":
        text = as_json(records, classes, predictor.result.target)
    else:
        text = as_csv(records, classes)
    lines.append(_save(out, text))
    if settings.page:
        title = f"{Path(settings.input or settings.depth).name}, as {settings.ckpt} sees it"
        html = page(title, rows, gallery, classes, trained_on)
        lines.append(_save(out.with_suffix(".html"), html))
    return "\n".join(lines), sum(row.probabilities is None for row in rows)


def _trained_on(ckpt: str) -> str:
    """What the data of the classifier's run are made of; "" where nothing beside its file says."""
    try:
        metrics = read_metrics(find_result(ckpt).parent)
    except DataError:  # it tells of the run, and no prediction depends on it
        return ""
    return metrics.data_text if metrics else ""


def _camera_is_missing(predictor: Predictor, settings: Settings) -> bool:
    given = settings.floor is not None or settings.camera_height is not None
    return predictor.needs_floor and not given and predictor.camera_height is None


def _save(path: Path, text: str) -> str:
    replaces = path.exists()
    write_text(path, text)
    return saved(path, replaces)


def saved(out: str | Path, replaces: bool) -> str:
    """Says where a file lies now, and that another one lay there."""
    return f"saved {out}" + " (replaced what was there)" * replaces


def _clouds(settings: Settings) -> Callable[[Predictor], Inputs]:
    """What finds the clouds for a net; what is not there is told before the net is read."""
    files, root, others = find_files(settings.input)
    archive = len(files) == 1 and files[0].is_file() and is_archive(files[0])
    if archive and settings.up not in ("", "z"):
        raise ConfigError(f"up={settings.up}: in an archive of objects z points up")
    if settings.part and not archive:
        raise ConfigError(f"part={settings.part}: {settings.input} is not an archive of objects")

    def find(predictor: Predictor) -> Inputs:
        if archive:
            units, part = archive_units(files[0], settings.part, predictor.classes)
            return Inputs(units, 0, "objects", part)
        units = cloud_units(files, root, settings.up or "z", predictor.classes)
        return Inputs(units, others, "files")

    return find


def _depth_images(settings: Settings) -> Callable[[Predictor], Inputs]:
    """What finds the depth images for a net; likewise."""
    common = Shown(
        "",
        box=numbers(settings.box, 4, "box") if settings.box else None,
        intrinsics=settings.intrinsics,
        up=direction(settings.up),
        scale_m=settings.depth_scale,
    )
    if settings.part:
        raise ConfigError(f"part={settings.part} is for an archive of objects, input=FILE.npz")
    shown, others = find_shown(settings.depth, settings.mask, common)
    if not any(one.intrinsics for one in shown):
        raise ConfigError(
            "intrinsics=fx,fy,cx,cy of the depth camera in pixels, or intrinsics=FILE, is missing"
        )

    def find(predictor: Predictor) -> Inputs:
        units = depth_units(shown, predictor.result.gravity, predictor.classes)
        return Inputs(units, others, "depth images")

    return find


def predict_units(
    predictor: Predictor,
    units: Iterable[Unit],
    settings: Settings,
    advance: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Row, Sample | None]]:
    """A row for each cloud, in order, and what it was made of; `advance` is called after a unit.

    Each of `settings.threads` threads has a batch of its own: the work between products of
    matrices does not gain from several threads in one batch. A few batches are in memory.
    """
    threads_before = torch.get_num_threads()
    pool = ThreadPoolExecutor(settings.threads, initializer=torch.set_num_threads, initargs=(1,))
    running: deque[Future[list[tuple[Row, Sample | None]]]] = deque()
    net, height = predictor.net, settings.camera_height
    floor = settings.floor if height is None else -height
    try:
        # Once for all: threads that change and restore a net's domain would do it to one another.
        with use_domain(net, norms_for(net, "target")):
            for batch in _batches(units, settings.batch_size, advance):
                running.append(pool.submit(_judged, predictor, batch, floor))
                if len(running) > 2 * settings.threads:
                    yield from running.popleft().result()
            while running:
                yield from running.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(threads_before)  # libraries below torch keep one number for all


def _batches(
    units: Iterable[Unit], size: int, advance: Callable[[], None]
) -> Iterator[list[Row | Sample]]:
    """The clouds of all units, `size` at a time; what cannot be read is a row already."""
    batch: list[Row | Sample] = []
    for unit in units:
        for item in unit():
            batch.append(item)
            if len(batch) == size:
                yield batch
                batch = []
        advance()
    if batch:
        yield batch


def _judged(
    predictor: Predictor, batch: Sequence[Row | Sample], floor: float | None
) -> list[tuple[Row, Sample | None]]:
    """The rows of a batch: each cloud prepared, and one pass of the net."""
    prepared: dict[int, tuple[Sample, Prepared]] = {}
    rows: dict[int, tuple[Row, Sample | None]] = {}
    for i, item in enumerate(batch):
        if isinstance(item, Row):
            rows[i] = item, None
            continue
        try:
            prepared[i] = item, predictor.prepare(item.cloud, item.name, item.axis, floor)
        except DataError as error:
            rows[i] = item.row(reason_of(error, item.name), None), None
    if prepared:
        points = torch.stack([each.points for _, each in prepared.values()])
        found = predictor.probabilities(points, len(points))
        for (i, (item, each)), probabilities in zip(prepared.items(), found, strict=True):
            rows[i] = item.row("; ".join(each.strange), probabilities), item
    return [rows[i] for i in range(len(batch))]


def _told(
    rows: Sequence[Row],
    records: Sequence[Mapping[str, Any]],
    inputs: Inputs,
    predictor: Predictor,
    settings: Settings,
    seconds: float,
) -> list[str]:
    """What was done, for the terminal."""
    good = [one for one in records if one["status"] == "ok"]
    failed = [one for one in records if one["status"] == "failed"]
    counts = Counter(one["class"] for one in good)
    rate = len(good) / max(seconds, 1e-9)
    lines = [
        f"{len(good)} clouds, {rate:.1f} clouds a second, from {len(inputs.units)} {inputs.kind}"
    ]
    if inputs.part:
        lines.append(f"taken: {inputs.part}")
    if good:
        lines.append("predicted " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
        lines += _scored(rows, predictor.classes)
        strange = sum(one["out_of_range"] for one in good)
        lines.append(f"{strange} of them out of range (column out_of_range)")
    if cautioned := sum(one["caution"] is not None for one in good):
        lines.append(f"{cautioned} of them with a caution (column caution)")
    lines += _vertical(rows)
    if holed := [one["dropped"] for one in good if one["dropped"]]:
        lines.append(
            f"{sum(holed)} points of {len(holed)} clouds are NaN or infinite and were left out "
            "(column dropped)"
            if inputs.kind == "files"
            else f"{sum(holed)} points of {len(holed)} objects have no depth or are stray (column "
            "dropped)"
        )
    if predictor.in_metres and inputs.kind == "files":
        lines.append("the classifier knows real sizes: the files' coordinates were taken as metres")
    if predictor.needs_floor and settings.floor is None and settings.camera_height is None:
        lines.append(
            f"the classifier knows heights: the camera counts as {predictor.camera_height:g} m "
            "above the floor ("
            + ("camera_height=" if settings.depth else "floor=")
            + " says otherwise)"
        )
    if predictor.result.gravity == "none" and inputs.kind != "depth images":
        lines.append("the classifier was trained on clouds in the frame of their camera, not z up")
    if inputs.others:
        lines.append(f"{inputs.others} files of other kinds passed over")
    if failed:
        lines.append(f"{len(failed)} failed:")
        lines += [f"  {one['file']}: {one['reason']}" for one in failed[:_SHOWN]]
        lines += [f"  and {len(failed) - _SHOWN} more, see the table"] * (len(failed) > _SHOWN)
    return lines


def _scored(rows: Sequence[Row], classes: Sequence[str]) -> list[str]:
    """Right and wrong, if somebody gave labels."""
    found = scores(rows, classes)
    if found is None:
        return []

    def of(count: Count) -> str:
        return f"{count.right} of {count.of} ({count.share:.1%})"

    tiers = "".join(f"; {tier} {of(count)}" for tier, count in found.tiers.items())
    label, times = found.majority
    return [f"right {of(found.all)}{tiers}; always {label}: {times / found.all.of:.1%}"]


def _vertical(rows: Sequence[Row]) -> list[str]:
    """Where up was not given."""
    counts = Counter(row.up for row in rows)
    words = {
        PLANES: "fitted to the planes of the picture",
        LEVEL: "not known, so the camera counts as level",
    }
    return [
        f"up of {counts[how]}: {says}; up= tells it" for how, says in words.items() if counts[how]
    ]
