"""meta.yaml: the description of a finished dataset; its last line is a checksum of the others."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import yaml  # type: ignore[import-untyped,unused-ignore]

from qs3.errors import DataError, MissingDataError
from qs3.utils.files import write_text

META = "meta.yaml"
AGAIN = "delete the folder and generate or import the dataset again"
_FORMAT = {"format": "qs3 point clouds", "format_version": 1}
_CHECKSUM = "# sha256 of the lines above: "
# A run opens its datasets some ten times, and libyaml is ten times as fast.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, kw_only=True)
class MadeOf:
    """Whose objects a dataset shows, and what gave the points: one line next to each figure.

    Attributes:
        objects: "published files", "embedded catalogue", "meshes of cad10", "own clouds of scans".
        published: whether these are the files that were published, and all of them: what papers'
            figures were measured on.
        sensor: name of the simulated one; "surface samples" if there is none; "" if the clouds
            were not made here.
        views: of each object; 0 without a sensor, or if not known.
        without: classes of the domain that have no object, such as "lamp, plant".
        benchmark: "kinectsim10 v2", a part of it, or that it is like it, for domains with versions.
        meshes: digits that all datasets made of these very meshes share; "" if not known.
        recipe: digits that datasets made of the same objects by the same settings and code share,
            on any machine; "" if not known.
    """

    objects: str = "not known (meta.yaml does not say)"
    published: bool = False
    sensor: str = ""
    views: int = 0
    without: str = ""
    benchmark: str = ""
    meshes: str = ""
    recipe: str = ""

    # metrics.json holds it, and is read strictly: see qs3.runs.metrics.
    __pydantic_config__: ClassVar[dict[str, Any]] = {"strict": True, "extra": "forbid"}

    @staticmethod
    def of(meta: Mapping[str, Any]) -> MadeOf:
        """From a store's meta.yaml."""
        return MadeOf(**(meta.get("made_of") or {}))

    @property
    def meta(self) -> dict[str, Any]:
        """For meta.yaml."""
        return {"made_of": dataclasses.asdict(self)}

    def __str__(self) -> str:
        """Such as "embedded catalogue, speckle_stereo, 5 views"."""
        views = f"{self.views} view{'s' * (self.views > 1)}" if self.views else ""
        without = f"without {self.without}" if self.without else ""
        parts = (self.objects, self.sensor, views, without, self.benchmark)
        return ", ".join(filter(None, parts))


def is_finished(folder: str | Path) -> bool:
    """Whether `folder` holds a dataset whose writing came to its end."""
    return (Path(folder) / META).is_file()


def is_begun(folder: str | Path) -> bool:
    """Whether something was begun in `folder` and not finished (an empty lock is nothing)."""
    folder = Path(folder)
    return (
        folder.is_dir()
        and not is_finished(folder)
        and any(path.name != ".lock" for path in folder.iterdir())
    )


def write_meta(folder: Path, facts: Mapping[str, Any], others: Mapping[str, Any]) -> None:
    """Write plain values with their checksum: from here on the dataset is finished.

    Keys of `others` must not be among those of the format or of `facts`.
    """
    document = {**_FORMAT, **facts}
    assert not document.keys() & others.keys()
    text = yaml.safe_dump({**document, **others}, sort_keys=False, allow_unicode=True, width=100)
    write_text(folder / META, text + _CHECKSUM + sha256_of(text) + "\n")


def read_meta(folder: str | Path) -> dict[str, Any]:
    """The contents of a finished dataset's meta.yaml, checked against its last line."""
    path = Path(folder) / META
    try:
        text = path.read_bytes().decode()
    except FileNotFoundError as error:
        raise MissingDataError(f"there is no finished dataset in {folder} (no {META})") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read ({error}); {AGAIN}") from error
    body, mark, checksum = text.rpartition(_CHECKSUM)
    if not mark or checksum != sha256_of(body) + "\n":
        raise DataError(f"{path} is damaged or was edited (its checksum is wrong); {AGAIN}")
    meta: dict[str, Any] = yaml.load(body, _LOADER)
    return meta


def sha256_of(text: str) -> str:
    """64 hex digits of its UTF-8 bytes."""
    return hashlib.sha256(text.encode()).hexdigest()
