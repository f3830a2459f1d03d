"""Folders of files: published trees `<class>/<split>/*`, and one's own clouds."""

from __future__ import annotations

import dataclasses
import functools
import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge

from qs3.classes import ALIASES
from qs3.datasets.clouds import (
    NOTHING,
    SUFFIXES,
    CloudFile,
    checked,
    parse_cloud,
    parse_clouds,
    with_depth,
)
from qs3.datasets.importing import (
    Importer,
    Item,
    UpAxis,
    by_class,
    class_of,
    cloud_id,
    file_item,
    files_in,
    folders_in,
    split_of,
    unique,
    visible,
)
from qs3.errors import DataError
from qs3.store.manifest import SPLITS, ManifestRow
from qs3.store.meta import MadeOf
from qs3.utils.files import reading
from qs3.utils.seeding import derive
from qs3.utils.settings import settings

log = logging.getLogger(__name__)

_SCANNET = re.compile(r"/(scene\d{4})_\d{2}(?:_|$)")
_SPLIT_NAMES = ("train", "test", "val", "validation")
_SPLIT_PREFIX = re.compile(rf"({'|'.join(_SPLIT_NAMES)})(?![a-z])", re.IGNORECASE)  # train_0.h5
_CLOUDS = (".xyz", ".npy")  # of published trees
_MANY = (".npy", ".npz", ".h5", ".hdf5")  # may hold several clouds


@settings
class PublishedTree(Importer):
    """One file a cloud, `<class>/<split>/<name>`.

    SpeckleNet10 and DepthScanNet10 are published as .xyz (text, 2048 rows of x y z), PointDA-10's
    ModelNet10 and ShapeNet10 as .npy ([2048, 3] and [1024, 3]). Clouds come split by split, in each
    class by class, in each sorted by file name: the order in which the code of the lineage lists
    them, and by which it cuts off its validation part.

    Attributes:
        up: axis that points up in the files.
        up_z_classes: classes whose files have z up whatever `up` is (ShapeNet10's plants).
    """

    up: UpAxis = "z"
    up_z_classes: list[str] = field(default_factory=list)

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/<class>/{{train,test}}/*.{{xyz,npy}}"

    def is_there(self) -> bool:
        """See `Importer`: whether the folder has a subfolder."""
        return any(folders_in(self.root))

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`."""
        found = list_tree(
            self.root, _CLOUDS, lambda name: class_of(name, classes, self.root / name)
        )
        order = sorted(found, key=lambda f: (SPLITS.index(f[2]), classes.index(f[1]), f[0].name))
        return unique(file_item(path, self.root, c, s, parse_cloud) for path, c, s in order)

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return cloud if cls in self.up_z_classes else super().turn(cloud, cls)

    def object_of(self, id_: str) -> str:
        """See `Importer`: the room, of ScanNet's ids such as "chair/test/scene0011_01_7".

        Rooms were scanned up to a dozen times (_00, _01, ...), with the same objects in them.
        """
        room = _SCANNET.search(id_)
        return room[1] if room else ""


@settings
class GraspNetPC(Importer):
    """GraspNetPC-10 (Shen et al., CVPR 2022): ten objects of GraspNet-1Billion seen by two sensors.

        {train,test}/{Real,Synthetic}/{kinect,realsense}/<0-9>/scene_XXXX_FFFF.xyz

    1024 rows of x y z, in the frame of the camera, already in the unit ball; there is no gravity
    axis. The classes are the objects 0, 2, 5, 8, 9, 15, 46, 48, 60, 66 of GraspNet, called 0 to 9.
    The test split is one scene an object, so its frames are highly correlated; the synthetic part
    has none.

    Attributes:
        part: "synthetic", rendered for both sensors; or the real frames of one.
    """

    points: Annotated[int, Ge(1)] = 1024
    part: Literal["synthetic", "kinect", "realsense"] = "synthetic"

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/{{train,test}}/{{Real,Synthetic}}/{{kinect,realsense}}/<0-9>/*.xyz"

    def is_there(self) -> bool:
        """See `Importer`: whether a training part is there."""
        return any(folder.is_dir() for _, _, folder in self._folders() if "train" in folder.parts)

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, class, sensor and name."""
        found = []
        for split, sensor, of_sensor in self._folders():
            for folder in folders_in(of_sensor):
                cls = class_of(folder.name, classes, folder)
                for path in files_in(folder, (".xyz",)):
                    name = f"{sensor}_{path.stem}"
                    found.append(file_item(path, self.root, cls, split, parse_cloud, name))
        return by_class(found, classes)

    def _folders(self) -> list[tuple[str, str, Path]]:
        """Split, sensor and folder of each."""
        sensors = ("kinect", "realsense") if self.part == "synthetic" else (self.part,)
        reality = "Synthetic" if self.part == "synthetic" else "Real"
        return [
            (split, sensor, self.root / split / reality / sensor)
            for split in ("train", "test")
            for sensor in sensors
        ]

    def object_of(self, id_: str) -> str:
        """See `Importer`: each class is one object."""
        return id_.split("/")[0]


@settings
class ModelNetMeshes(Importer):
    """ModelNet's CAD meshes, `<class>/{train,test}/*.off`, sampled here: P points on each surface.

    The folder is that of the unpacked archive, or the root of torch_geometric.datasets.ModelNet,
    which keeps the same tree in `raw/`. Points are uniform on the area, as PyG's SamplePoints and
    PointDA-10 draw them; every object has its own seed, made from the dataset's seed and the
    object's id, so the order of reading changes nothing. The files stand on z, in the units of
    their makers. They are read by `qs3.meshes`: PyG's reader (2.8.1) silently passes over polygons
    of more than four corners and takes truncated files; a test shows it. Folders of other classes
    than the wanted ones are left alone.

    Attributes:
        seed: of the dataset; another one gives other points on the same surfaces.
    """

    seed: Annotated[int, Ge(0)] = 0

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects="ModelNet's published meshes", sensor="surface samples")

    def looks_for(self) -> str:
        """See `Importer`."""
        return f"{self.root}/[raw/]<class>/{{train,test}}/*.off"

    def is_there(self) -> bool:
        """See `Importer`: whether there is a folder with a folder `train`."""
        return any((folder / "train").is_dir() for folder in folders_in(self._tree))

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, in it by class, in it by name."""
        tree = self._tree

        def named(folder: str) -> str | None:
            # A name that is wanted as it is comes before its meaning among the ten: `night_stand`
            # is itself in ModelNet40 and `cabinet` in PointDA-10.
            name = folder.casefold()
            return next((c for c in (name, ALIASES.get(name)) if c in classes), None)

        found = []
        for path, cls, split in list_tree(tree, (".off",), named):
            seed = derive(self.seed, "modelnet surface", cloud_id(cls, split, path.stem))
            load = functools.partial(sample_file, points=self.points, seed=seed)
            item = file_item(path, tree, cls, split, load)
            found.append(item._replace(row=dataclasses.replace(item.row, seed=seed)))
        return by_class(unique(found), classes)

    @property
    def _tree(self) -> Path:
        return self.root / "raw" if (self.root / "raw").is_dir() else self.root


@settings
class CloudFolder(Importer):
    """Your own clouds: a folder of files in any format of `datasets.clouds`.

        class/split/name.ext     split is train, test, or val (validation)
        split/class/name.ext
        class/name.ext           every `test_every`-th of a class, sorted by name, is for test
        split/name.ext           no labels
        name.ext, any/where.ext  no labels: all of it is the split "train"

    A file may hold several clouds (.npy, .npz, .h5 with an array [m, n, 3]); they are then called
    name_0000, name_0001, ... If it has labels, numbers count the classes from 0 and words are
    names. Such a file may have its split before its name, train_0.h5, where no folder is one.

    A cloud with more than P points is thinned to its P farthest; one with fewer repeats its points.
    Points without depth are left out before (`with_depth`).

    Attributes:
        layout: one of those above; "auto" looks at the names of the folders.
        up: the axis that points up in the files.
        test_every: of the layout "class"; 0 leaves nothing for test.
    """

    layout: Literal["auto", "class/split", "split/class", "class", "none"] = "auto"
    up: UpAxis = "z"
    test_every: Annotated[int, Ge(0)] = 5
    thins: ClassVar[bool] = True

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"own clouds of {self.root.name}")

    def looks_for(self) -> str:
        """See `Importer`."""
        kinds = " ".join(f"*{suffix}" for suffix in SUFFIXES)
        return f"{self.root}/[<class>/][{{train,test}}/]: {kinds} (published.folder=PATH)"

    def is_there(self) -> bool:
        """See `Importer`: whether there is any file of a known format."""
        return next(_files(self.root), None) is not None

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. Sorted by split, class and name."""
        layout = self._layout(classes)
        log.info("%s is read in the layout %s", self.root, layout)
        read = functools.lru_cache(maxsize=1)(parse_clouds)  # one file in memory at a time
        found: list[Item] = []
        for path in _files(self.root):
            found += self._of_file(path, *self._place(path, layout, classes), layout, classes, read)
        found = unique(found)
        if self.test_every and layout == "class":
            found = _with_tests(found, self.test_every)
        return by_class(found, classes)

    def watched(self) -> Iterable[Path]:
        """See `Importer`."""
        return _files(self.root)

    def _layout(self, classes: Sequence[str]) -> str:
        """The layout in the names of the folders; DataError if they fit none."""
        if self.layout != "auto":
            return self.layout
        folders = [f for f in folders_in(self.root) if next(_files(f), None) is not None]
        if not folders:
            return "none"
        if all(_is_split(f.name) for f in folders):
            return "split/class"
        for folder in folders:
            class_of(folder.name, classes, f"{folder} (published.layout=none reads without labels)")
        inner = [e for f in folders for e in folders_in(f)]
        return "class/split" if inner and all(_is_split(e.name) for e in inner) else "class"

    def _place(self, path: Path, layout: str, classes: Sequence[str]) -> tuple[str, str]:
        """Class and split of a file by its folders; each "" where they do not say."""
        if layout == "none":
            return "", ""
        parts, wanted = path.relative_to(self.root).parts[:-1], layout.split("/")
        if layout == "split/class" and len(parts) == 1:  # clouds without labels, in splits
            wanted = ["split"]
        if len(parts) != len(wanted):
            raise DataError(f"{path} does not lie in a folder {layout}")
        named = dict(zip(wanted, parts, strict=True))
        cls = class_of(named["class"], classes, path) if "class" in named else ""
        return cls, split_of(named.get("split", "train"), path)

    def _of_file(
        self,
        path: Path,
        cls: str,
        split: str,
        layout: str,
        classes: Sequence[str],
        read: Callable[[Path], CloudFile],
    ) -> list[Item]:
        """The clouds of a file; of those that may hold several only number and labels are kept."""
        origin, below = path.relative_to(self.root).as_posix(), path.relative_to(self.root)
        file, wrong = CloudFile((np.empty(0),)), None
        if path.suffix.lower() in _MANY:
            try:
                file = read(path)
            except DataError as error:
                wrong = error
        if not split:
            prefix = _SPLIT_PREFIX.match(path.stem) if file.many else None
            split = split_of(prefix[1].lower(), path) if prefix else "train"
        found = []
        for i in range(len(file.clouds)):
            where = f"{path}, cloud {i}" if file.many else str(path)
            load: Callable[[], np.ndarray] = functools.partial(_cloud, read, path, i, where)
            own = cls
            try:
                if wrong is not None:
                    raise wrong
                if file.labels and not cls:
                    own = _label(file.labels[i], classes, where)
            except DataError as error:
                load = functools.partial(_raise, error)
            # Folders are class or split, unless there are neither.
            name = below.with_suffix("").as_posix() if layout == "none" and not own else path.stem
            name += f"_{i:04d}" if file.many else ""
            place = f"{origin}[{i}]" if file.many else origin
            row = ManifestRow(cloud_id(own, split, name), own, split, origin=place)
            found.append(Item(row, where, load))
        return found


def list_tree(
    root: Path, suffixes: Sequence[str], class_named: Callable[[str], str | None]
) -> Iterator[tuple[Path, str, str]]:
    """Path, class and split of all files `root/<class>/<split>/*` with one of the suffixes.

    Hidden files, other extensions, and folders of no class (None) are passed over.
    """
    for class_folder in folders_in(root):
        cls = class_named(class_folder.name)
        for folder in folders_in(class_folder) if cls is not None else ():
            split = split_of(folder.name, class_folder)
            yield from ((path, cls or "", split) for path in files_in(folder, suffixes))


def sample_file(path: Path, points: int, seed: int) -> np.ndarray:
    """[points, 3] float32, uniform on the surface of a mesh file, in its axes and units."""
    from qs3.geometry.sampling import surface_sample
    from qs3.meshes.io import load_mesh

    with reading(path):
        mesh = load_mesh(path)
        cloud = surface_sample(mesh.vertices, mesh.faces, points, np.random.default_rng(seed))
    return cloud.astype(np.float32)


def _cloud(read: Callable[[Path], CloudFile], path: Path, number: int, where: str) -> np.ndarray:
    """[n, 3] float32, without points that have no depth, and checked."""
    cloud, dropped = with_depth(read(path).clouds[number], where)
    if dropped:
        log.info("%s: points that are %s left out: %d", where, NOTHING, dropped)
    return checked(cloud, where)


def _with_tests(items: Iterable[Item], every: int) -> list[Item]:
    """The last of every `every` of a class, in the order of ids, goes to test."""
    seen: Counter[str] = Counter()
    result = []
    for item in sorted(items, key=lambda item: item.row.id):
        row = item.row
        seen[row.cls] += 1
        if seen[row.cls] % every == 0:
            id_ = cloud_id(row.cls, "test", row.id.removeprefix(f"{row.cls}/train/"))
            item = item._replace(row=dataclasses.replace(row, id=id_, split="test"))
        result.append(item)
    return result


def _label(label: Any, classes: Sequence[str], where: str) -> str:
    """The class that a file's own label means: a name, or a number from 0."""
    if isinstance(label, bytes):
        label = label.decode(errors="replace")
    if isinstance(label, int) and 0 <= label < len(classes):
        return classes[label]
    return class_of(str(label), classes, where)


def _is_split(name: str) -> bool:
    return name.casefold() in _SPLIT_NAMES


def _files(folder: Path) -> Iterator[Path]:
    """All files of known formats below a folder, in order; links to folders are not followed."""
    for path in visible(folder):
        if path.is_dir():
            if not path.is_symlink():  # it could lead in a circle, or give the same clouds twice
                yield from _files(path)
        elif path.suffix.lower() in SUFFIXES and path.is_file():
            yield path


def _raise(error: DataError) -> np.ndarray:
    raise error
