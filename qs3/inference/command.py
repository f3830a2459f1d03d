"""Clouds or depth images in, a table and a page out: read, prepare, predict in batches, save."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from qs3.datasets.depth_images import read_intrinsics
from qs3.datasets.object_archive import is_archive, read_archive
from qs3.errors import ConfigError, DataError
from qs3.evaluation.prior import read_prior
from qs3.inference import pretrained
from qs3.inference.depth_list import Shown, direction, find_shown, numbers
from qs3.inference.draw import clouds_in, draw, objects_in
from qs3.inference.floor import Floor, camera_is_missing, floor_is_missing, floor_under
from qs3.inference.inputs import (
    Sample,
    Unit,
    archive_part,
    archive_units,
    cloud_units,
    depth_units,
    find_files,
    printable_name,
)
from qs3.inference.model_file import PACKAGES, find_result
from qs3.inference.page import Gallery, page
from qs3.inference.predictor import Predictor, learnt_of, load
from qs3.inference.settings import Inputs, Settings, Source
from qs3.inference.table import Row, as_csv, as_json, record
from qs3.inference.told import agreement, chosen, told
from qs3.inference.trusted import trust_of, without_labels
from qs3.inference.units import predict_units
from qs3.runs.metrics import Trust, read_metrics
from qs3.store.meta import is_finished
from qs3.utils.files import make_folder, write_text
from qs3.utils.plural import counted
from qs3.utils.progress import progress_bar

log = logging.getLogger(__name__)

FEW = 64
"""Files of which the clouds are counted before they are read."""


def predict_command(settings: Settings) -> tuple[str, int]:
    """Predict and save.

    Returns:
        The text for the terminal, and how many clouds failed.

    Raises:
        ConfigError, MissingDataError, DataError: nothing could be done at all.
    """
    _check_out(settings, settings.input, settings.depth, settings.mask)
    source = _depth_images(settings) if settings.depth else _clouds(settings)
    ckpt = settings.ckpt or pretrained.usual(source.floor_known)
    predictor = _loaded(ckpt, settings)
    found, given = _floor(source, settings, predictor), settings
    if found:
        settings = replace(settings, floor=found.z)
    second = _second(settings, ckpt, predictor)
    heights = any(one.needs_floor for one in (predictor, second) if one)
    _check_heights(given, heights, ckpt)
    classes = predictor.classes
    inputs = source.find(predictor)
    if predictor.needs_floor and inputs.kind == "files" and settings.floor is None:
        raise floor_is_missing()
    inputs = draw(inputs, settings.sample)
    if _camera_is_missing(predictor, settings):
        key = "camera_height=METRES" if settings.depth else "floor=-METRES"
        why = f" ({source.floor.words})" if source.floor else ""
        raise camera_is_missing(key, why)
    out = Path(settings.out).expanduser()
    make_folder(out.parent)
    began, gallery = time.monotonic(), Gallery(classes)
    rows: list[Row] = []
    try:
        label, sizes = _steps(inputs)
        with progress_bar(label, total=sum(sizes or [1] * len(inputs.units))) as advance:
            after, units = (_nothing if sizes else advance), inputs.units
            if sizes:
                units = [partial(_all_of, *one, advance) for one in zip(units, sizes, strict=True)]
            for row, sample in predict_units(predictor, units, settings, after, second):
                rows.append(row)
                if sizes:
                    advance()
                if sample and settings.page:
                    gallery.add(row, sample)
    except BaseException as error:
        _save_part(out, rows, predictor)
        if not isinstance(error, torch.OutOfMemoryError):
            raise
        batches = counted(settings.threads, "batch", "batches")
        raise ConfigError(
            f"device={settings.device} has no memory for {batches} of "
            f"{counted(settings.batch_size, 'cloud')} at a time: give a smaller batch_size=, or "
            f"threads=1 ({str(error).splitlines()[0]})"
        ) from error
    seconds = time.monotonic() - began
    records = [record(row, classes) for row in rows]
    trained_on, worth = _trained_on(ckpt), predictor.result.worth
    if worth and predictor.prior:
        worth += "; without prior="
    taken = [found.words] if found and heights else []
    taken += [predictor.prior.words] if predictor.prior else []
    trust, verdict = trust_of(rows, predictor)
    lines = [] if settings.ckpt else [chosen(ckpt, source)]
    lines += taken
    lines += told(rows, records, inputs, predictor, settings, seconds)
    if any(row.probabilities is not None for row in rows):  # else nothing was said to be judged
        lines.append(without_labels(verdict, rows, classes))
        lines += [agreement(rows, classes)] if second else []
        lines += [f"the classifier's data: {trained_on}"] * bool(trained_on)
        lines += [f"what it is worth: {worth}"] * bool(worth)
    lines.append(_save(out, _table(out, records, predictor, trust)))
    if settings.page:
        title = f"{_title(settings.input or settings.depth)}, as {printable_name(ckpt)} sees it"
        where = _floor_m(settings, predictor)
        shown = without_labels(verdict, rows, classes)
        html = page(title, rows, gallery, classes, trained_on, worth, taken, shown, where)
        lines.append(_save(out.with_suffix(".html"), html))
    return "\n".join(lines), sum(row.probabilities is None for row in rows)


def _steps(inputs: Inputs) -> tuple[str, Sequence[int] | None]:
    """What the progress counts: the objects, so many of each file, or (None) the files.

    Objects where there are few files, one of which may hold thousands; to count those of many files
    would take as long as to read them.
    """
    if inputs.sizes is None or len(inputs.units) > FEW:
        return f"{inputs.kind} read", None
    return "clouds", inputs.sizes()


def _all_of(unit: Unit, size: int, advance: Callable[[], None]) -> Iterator[Sample | Row]:
    """A unit; `advance` is called for those of its objects that it does not give: it is damaged."""
    given = 0
    for item in unit():
        given += 1
        yield item
    for _ in range(size - given):
        advance()


def _nothing() -> None:
    """Of a step that is not counted."""


def _table(
    out: Path, records: Sequence[Mapping[str, Any]], predictor: Predictor, trust: Trust | None
) -> str:
    if out.suffix.lower() != ".json":
        return as_csv(records, predictor.classes)
    about = (trust, predictor.prior, trust is not None and predictor.before_target is not None)
    return as_json(records, predictor.classes, predictor.result.target, *about)


def _save_part(out: Path, rows: Sequence[Row], predictor: Predictor) -> None:
    """Save what was said before something stopped it, beside `out`, where a whole table may lie."""
    if rows:
        part = out.with_name(f"{out.stem}.part{out.suffix}")
        records = [record(row, predictor.classes) for row in rows]
        words = _save(part, _table(part, records, predictor, None))
        log.warning(
            "stopped after %s: %s, which is no whole table", counted(len(rows), "cloud"), words
        )


def _title(place: str) -> str:
    """Name of a file or folder, also of one that is given as "." or ".."."""
    whole = os.path.abspath(Path(place).expanduser())
    return printable_name(os.path.basename(whole) or whole)


def _loaded(name: str, settings: Settings) -> Predictor:
    prior = settings.prior or None
    return load(
        name,
        device=settings.device,
        packages=(*PACKAGES, *settings.packages),
        prior=prior,
        prior_power=settings.prior_power,
    )


def _floor(source: Source, settings: Settings, predictor: Predictor) -> Floor | None:
    """What the clouds say of the floor; None if nobody need ask them, or they cannot tell.

    A net of one's own that was adapted to a camera's clouds knows that camera's height.
    """
    known = bool(settings.ckpt) and predictor.camera_height is not None
    return None if known or source.floor is None or source.floor.z is None else source.floor


def _floor_m(settings: Settings, predictor: Predictor) -> float | None:
    """Where the net takes the floor to be; None if it knows no heights."""
    if not predictor.needs_floor:
        return None
    if settings.camera_height is not None:
        return -settings.camera_height
    return predictor.result.floor_m if settings.floor is None else settings.floor


def _trained_on(ckpt: str) -> str:
    """What the data of the classifier's run are made of; "" where nothing beside its file says."""
    try:
        metrics = read_metrics(find_result(ckpt).parent)
    except DataError:  # it tells of the run, and no prediction depends on it
        return ""
    return metrics.data_text if metrics else ""


def _second(settings: Settings, ckpt: str, first: Predictor) -> Predictor | None:
    """The classifier that is asked, too."""
    name = settings.second or ("none" if settings.ckpt else pretrained.other_than(ckpt))
    if name == "none":
        return None
    second = _loaded(name, replace(settings, prior=""))  # which is of the first one's classes
    if sorted(second.classes) != sorted(first.classes):
        raise ConfigError(
            f"second={name} tells {', '.join(second.classes)} apart, the first classifier "
            f"{', '.join(first.classes)}"
        )
    if second.result.gravity != first.result.gravity:
        raise ConfigError(f"second={name} wants clouds in another frame than the first classifier")
    if second.needs_floor and settings.floor is None and settings.camera_height is None:
        raise ConfigError(f"second={name} knows heights: give floor= or camera_height=")
    if not settings.prior:
        return second
    learnt = learnt_of(second.result)
    prior = read_prior(settings.prior, second.classes, learnt, settings.prior_power)
    return replace(second, prior=prior)


def _check_heights(settings: Settings, heights: bool, ckpt: str) -> None:
    """Raise ConfigError if a height is given that no classifier looks at."""
    given = [key for key in ("floor", "camera_height") if getattr(settings, key) is not None]
    if given and not heights:
        raise ConfigError(
            f"{given[0]}= would have no effect: ckpt={ckpt} knows no heights; leave it out, or "
            "take a classifier that does, such as dgcnn-rooms"
        )


def _camera_is_missing(predictor: Predictor, settings: Settings) -> bool:
    given = settings.floor is not None or settings.camera_height is not None
    return predictor.needs_floor and not given and predictor.camera_height is None


def _check_out(settings: Settings, *read: str | Path) -> None:
    """Raise ConfigError if table or page would replace a file that is read, or a folder is there.

    Asked first: what was predicted would be lost when it is saved.
    """
    table = Path(settings.out).expanduser()
    for out in (table, table.with_suffix(".html")) if settings.page else (table,):
        if os.path.isdir(out):
            raise ConfigError(f"out={settings.out}: {out} is a folder; give the name of a file")
        for file in (os.path.expanduser(place) for place in dict.fromkeys(read)):
            if os.path.isfile(file) and os.path.exists(out) and os.path.samefile(file, out):
                raise ConfigError(
                    f"out={settings.out} would replace {file}, which is read; give another name"
                )


def _save(path: Path, text: str) -> str:
    replaces = path.exists()
    write_text(path, text)
    return saved(path, replaces)


def saved(out: str | Path, replaces: bool) -> str:
    """Says where a file lies now, and that another one lay there."""
    return f"saved {printable_name(str(out))}" + " (replaced what was there)" * replaces


def _clouds(settings: Settings) -> Source:
    """Clouds of files or of an archive; what is not there is told before the net is read."""
    if is_finished(Path(settings.input).expanduser()):
        raise ConfigError(
            f"input={settings.input} is a dataset of qs3, with other arrays beside its clouds: "
            f"give input={Path(settings.input, 'points.npy')}"
        )
    files, root, others = find_files(settings.input)
    if len(files) == 1 and files[0].is_file() and is_archive(files[0]):
        return _archive(files[0], settings)
    if settings.part:
        raise ConfigError(f"part={settings.part}: {settings.input} is not an archive of objects")

    def find(predictor: Predictor) -> Inputs:
        units = cloud_units(files, root, settings.up or "z", predictor.classes)
        return Inputs(units, others, "files", sizes=lambda: clouds_in(files))

    return Source(find, settings.floor is not None, "floor=Z, if they are in metres,")


def _archive(path: Path, settings: Settings) -> Source:
    """Objects of an archive: in metres, the camera at the origin."""
    if settings.up not in ("", "z"):
        raise ConfigError(f"up={settings.up}: in an archive of objects z points up")
    archive = read_archive(path)
    chosen, part = archive_part(archive, settings.part)

    def find(predictor: Predictor) -> Inputs:
        return Inputs(archive_units(archive, chosen, predictor.classes), {}, "objects", part)

    given = settings.floor is not None
    floor = None if given else floor_under(archive.cloud(i, True) for i in chosen)
    return Source(find, given, "floor=-METRES, minus the camera's height,", floor)


def _depth_images(settings: Settings) -> Source:
    """Objects of depth images; likewise."""
    common = Shown(
        "",
        box=numbers(settings.box, 4, "box") if settings.box else None,
        intrinsics=settings.intrinsics,
        up=direction(settings.up),
        scale_m=settings.depth_scale,
    )
    if settings.part:
        raise ConfigError(f"part={settings.part} is for an archive of objects, input=FILE.npz")
    if settings.intrinsics:  # else all objects would fail, over a table that may be there
        read_intrinsics(settings.intrinsics)
    shown, others = find_shown(settings.depth, settings.mask, common)
    _check_out(settings, *(one.folder / Path(one.intrinsics).expanduser() for one in shown))
    if not any(one.intrinsics for one in shown):
        raise ConfigError(
            "intrinsics=fx,fy,cx,cy of the depth camera in pixels, or intrinsics=FILE, is missing"
        )

    def find(predictor: Predictor) -> Inputs:
        units = depth_units(shown, predictor.result.gravity, predictor.classes)
        return Inputs(units, others, "depth images", sizes=lambda: objects_in(shown))

    return Source(find, settings.camera_height is not None, "camera_height=METRES")
