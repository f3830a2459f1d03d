"""What nets call the objects of an archive: asked now, or kept of an earlier judgement.

A net's weights are large and stay on the machine that trained it; what it called each object is a
few kilobytes. `qs3 report judge keep=FOLDER` writes those, and `runs=` takes them up again, beside
runs that were trained elsewhere.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from qs3.classes import known_as
from qs3.datasets.importers.object_archive import Archive
from qs3.errors import ConfigError, DataError, MissingDataError
from qs3.evaluation.prior import POWER
from qs3.inference.model_file import FILE, find_result
from qs3.inference.predictor import Predictor, load
from qs3.runs.metrics import METRICS, read_metrics, write_metrics
from qs3.utils.files import sha256_file, write_text
from qs3.utils.json_file import read_json
from qs3.utils.progress import progress_bar

_Count = Annotated[int, Field(ge=0)]
_Word = Annotated[str, Field(max_length=64)]


@dataclass(frozen=True, kw_only=True, config=ConfigDict(strict=True, extra="forbid"))
class Asked:
    """Of what a net was asked.

    Attributes:
        sha256: of the archive.
        part: of it; "" for all.
        inliers_only: whether stray points were left out.
        floor: z of the floor, for nets that know heights; None: as in the run's target.
        prior, prior_power: how common classes counted as; "": as in training. See
            `qs3.evaluation.prior`.
    """

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    part: _Word
    inliers_only: bool
    floor: Annotated[float, Field(allow_inf_nan=False)] | None
    prior: Annotated[str, Field(max_length=4096)] = ""
    prior_power: Annotated[float, Field(allow_inf_nan=False, ge=0)] = POWER


@dataclass(frozen=True, kw_only=True, config=ConfigDict(strict=True, extra="forbid"))
class Answers:
    """What one net called the objects whose classes it knows.

    Attributes:
        asked: of what.
        classes: that the net knows.
        points: of a cloud as it sees them.
        target: what it was adapted to.
        objects: positions in the archive, ascending.
        called: a position in `classes` for each.
    """

    asked: Asked
    classes: Annotated[tuple[_Word, ...], Field(min_length=1, max_length=1000)]
    points: _Count
    target: Annotated[str, Field(max_length=1000)]
    objects: tuple[_Count, ...]
    called: tuple[_Count, ...]

    def __post_init__(self) -> None:
        """Refuse what does not hang together."""
        if len(self.objects) != len(self.called):
            raise ValueError("objects and called should be of one length")
        if list(self.objects) != sorted(set(self.objects)):
            raise ValueError("objects should ascend")
        if any(k >= len(self.classes) for k in self.called):
            raise ValueError("called should be positions in classes")


def asked_of(
    archive: Archive,
    part: str,
    inliers_only: bool,
    floor: float | None,
    prior: str = "",
    prior_power: float = POWER,
) -> Asked:
    """What is asked now."""
    return Asked(
        sha256=sha256_file(archive.path),
        part=part,
        inliers_only=inliers_only,
        floor=None if floor is None else float(floor),
        prior=prior,
        prior_power=float(prior_power),
    )


def kept_name(part: str, prior: str = "") -> str:
    """The file's name, beside the run's `metrics.json`: such as "judged-adapt.json".

    Answers with a prior, of which a folder keeps one, are in "judged-adapt-prior.json".
    """
    return f"judged-{part or 'all'}{'-prior' * bool(prior)}.json"


def answers_of(
    files: Sequence[Path], archive: Archive, chosen: Sequence[int], asked: Asked, device: str
) -> dict[Path, Answers]:
    """Of each run: its net's, or those that were kept.

    Args:
        files: from `find_runs`.
        archive: of objects.
        chosen: positions of the part that is asked.
        asked: of what; kept answers must be to the same.
        device: of the nets.

    Raises:
        DataError: a file is damaged.
        ConfigError: a net cannot be judged so, or was asked something else.
    """
    kept = {file: read_answers(file, asked) for file in files if _is_kept(file)}
    nets = _loaded([file for file in files if file not in kept], asked, device)
    found: dict[Path, Answers] = {}
    if nets:
        clouds = {i: archive.cloud(i, asked.inliers_only) for i in chosen}
        with progress_bar("judging runs", total=len(nets)) as advance:
            for file, net in nets.items():
                found[file] = _ask(net, clouds, archive, asked)
                advance()
    return {file: kept[file] if file in kept else found[file] for file in files}


def _ask(
    net: Predictor, clouds: Mapping[int, np.ndarray], archive: Archive, asked: Asked
) -> Answers:
    objects = [i for i in clouds if known_as(str(archive.cls[i]), net.classes) is not None]
    called = np.zeros(0, dtype=int)
    if objects:
        names = [f"{archive.path.name}[{i}]" for i in objects]
        called = net([clouds[i] for i in objects], names=names, floor=asked.floor).argmax(axis=1)
    return Answers(
        asked=asked,
        classes=tuple(net.classes),
        points=net.points,
        target=net.result.target,
        objects=tuple(map(int, objects)),
        called=tuple(map(int, called)),
    )


def _loaded(files: Sequence[Path], asked: Asked, device: str) -> dict[Path, Predictor]:
    """The classifiers, all for clouds with z up; and a camera's, if they know heights."""
    told: dict[str, Any] = {"prior": asked.prior or None, "prior_power": asked.prior_power}
    found = {file: load(file, device=device, **told) for file in files}
    for file, one in found.items():
        if one.result.gravity != "z":
            raise ConfigError(
                f"{file} was trained on clouds in the frame of their camera; the archive's have z "
                "up, so it cannot be judged on them"
            )
        if one.needs_floor and one.camera_height is None and asked.floor is None:
            raise ConfigError(
                f"{file} knows heights above the floor, and its target's clouds stand at "
                f"{one.result.floor_m:g}: the archive's have the camera at the origin; give "
                "floor=-METRES, minus the camera's height"
            )
    return found


def check_keepable(files: Sequence[Path], folder: Path, asked: Asked) -> None:
    """Before nets are asked: whether their answers can be kept below a folder.

    Answers that lie there to the same are written anew; those to something else stay.

    Raises:
        ConfigError: a run has no `metrics.json`, or answers to something else lie in its place.
        DataError: what lies there is damaged.
    """
    for file in files:
        place = _place(file, folder) / kept_name(asked.part, asked.prior)
        if not place.is_file():
            continue
        try:
            read_answers(place, asked)
        except ConfigError as error:
            raise ConfigError(
                f"{error}; they would be lost: give another folder, keep=FOLDER"
            ) from error
        except DataError as error:
            raise DataError(f"{error}; delete it, or give another folder, keep=FOLDER") from error


def keep_answers(found: Mapping[Path, Answers], folder: Path) -> None:
    """Write them below a folder, after `check_keepable`.

    Layout: `<folder>/<experiment>/seed<seed>-<hash>/` with the run's `metrics.json`, as below
    `paths.log_dir` and as `qs3 report keep` has it.
    """
    for file, answers in found.items():
        check_keepable([file], folder, answers.asked)
    for file, answers in found.items():
        into = _place(file, folder)
        if into.resolve() == file.parent.resolve():
            continue  # taken up from there
        metrics = read_metrics(file.parent)
        assert metrics is not None
        into.mkdir(parents=True, exist_ok=True)
        write_metrics(into, metrics)
        write_text(into / kept_name(answers.asked.part, answers.asked.prior), _text(answers))


def _place(file: Path, folder: Path) -> Path:
    """The folder below `folder` for what the run of a file answered."""
    metrics = read_metrics(file.parent)
    if metrics is None:
        raise ConfigError(
            f"keep= needs the {METRICS} of a run, which says what it is; none is beside {file}"
        )
    return folder / metrics.experiment / f"seed{metrics.seed}-{metrics.hash}"


def _text(answers: Answers) -> str:
    """JSON, a line a field."""
    values: dict[str, Any] = asdict(answers)
    lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in values.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def read_answers(path: Path, asked: Asked) -> Answers:
    """Kept ones.

    Raises:
        DataError: the file cannot be read, or is damaged.
        ConfigError: they are to something else than `asked`.
    """
    found = read_json(path, Answers, "qs3 report judge keep=")
    was, now = asdict(found.asked), asdict(asked)
    if other := [f"{key}={was[key]}, now {now[key]}" for key in now if was[key] != now[key]]:
        raise ConfigError(f"{path} has answers to something else: {'; '.join(other)}")
    return found


def find_runs(runs: Sequence[str], part: str = "", prior: str = "") -> list[Path]:
    """The files that are meant, each once, in order: results of runs, or kept answers.

    Args:
        runs: folders of runs, folders of such folders, patterns, or files.
        part: of the archive that is asked, which kept answers have in their name.
        prior: likewise, whether there is one.

    Raises:
        MissingDataError: one is not there, or a folder holds none.
    """
    found: dict[Path, None] = {}
    for words in runs:
        places = [Path(words).expanduser()]
        if not places[0].exists() and glob.has_magic(words):
            places = sorted(map(Path, glob.glob(str(places[0]))))
            if not places:
                raise MissingDataError(f"runs={words} matches nothing")
        for place in places:
            for file in _below(place, kept_name(part, prior)) if place.is_dir() else [place]:
                found.setdefault(file if _is_kept(file) else find_result(file))
    if not found:
        raise ConfigError("runs= names no run; give folders of finished runs")
    return list(found)


def _below(folder: Path, name: str) -> list[Path]:
    """Results, and kept answers where there is no result beside them; else the folder itself."""
    results = list(folder.rglob(FILE))
    there = {file.parent for file in results}
    kept = [file for file in folder.rglob(name) if file.parent not in there]
    found = sorted(results + kept)
    if not found and (other := next(folder.rglob("judged-*.json"), None)):
        raise MissingDataError(
            f"{folder} has no {FILE}, and {other} answers something else than {name}"
        )
    return found or [folder]


def _is_kept(file: Path) -> bool:
    return file.name.startswith("judged-") and file.suffix == ".json"
