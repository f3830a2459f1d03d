"""Published datasets of clouds: trees of files, `<class>/<split>/*`, and files of many clouds."""

import abc
import dataclasses
import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge

from qs3.classes import known_as
from qs3.datasets.clouds import parse_cloud, read_arrays
from qs3.datasets.importing import (
    Importer,
    Item,
    UpAxis,
    by_class,
    class_of,
    cloud_id,
    file_item,
    split_of,
    turned,
)
from qs3.store.meta import SPLITS, MadeOf, ManifestRow
from qs3.utils.files import reading
from qs3.utils.seeding import derive
from qs3.utils.settings import Count, settings

Cloud = tuple[str, str, str, np.ndarray]
"""Class, split, name and points [P, 3] of one cloud."""

SCANOBJECTNN: tuple[str, ...] = (
    *("bag", "bin", "box", "cabinet", "chair", "desk", "monitor", "door", "bookshelf", "table"),
    *("bed", "pillow", "sink", "sofa", "toilet"),
)
"""ScanObjectNN's classes in the order of its labels, "display" and "shelf" by our names.

A desk is not a table: ModelNet40 has both."""

_MIRROR = np.array([1, -1, 1], dtype=np.float32)
_SCANNET = re.compile(r"/(scene\d{4})_\d{2}(?:_|$)")


@settings
class PublishedTree(Importer):
    """One file a cloud, `<class>/<split>/<name>`.

    SpeckleNet10 and DepthScanNet10 are published as .xyz (text, 2048 rows of x y z), PointDA-10's
    ModelNet10 and ShapeNet10 as .npy ([2048, 3] and [1024, 3]). Clouds come by split, class and
    file name, as the code of the lineage lists them, which so cuts off its validation part.

    Attributes:
        up: axis that points up in the files.
        up_z_classes: classes whose files have z up whatever `up` is (ShapeNet10's plants).
    """

    up: UpAxis = "z"
    up_z_classes: list[str] = field(default_factory=list)

    holds: ClassVar[str] = "*/*/*.*"

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`."""
        found = _tree(
            self.root, (".xyz", ".npy"), lambda name: class_of(name, classes, self.root / name)
        )
        order = sorted(found, key=lambda f: (SPLITS.index(f[2]), classes.index(f[1]), f[0].name))
        return [file_item(path, self.root, c, s, parse_cloud) for path, c, s in order]

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        return cloud if cls in self.up_z_classes else super().turn(cloud, cls)

    def object_of(self, id_: str) -> str:
        """See `Importer`: the room, scanned up to a dozen times, of "chair/test/scene0011_01_7"."""
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

    points: Count = 1024
    part: Literal["synthetic", "kinect", "realsense"] = "synthetic"

    holds: ClassVar[str] = "train/*/*/*/*.xyz"

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, class, sensor and name."""
        pattern = "Synthetic/*" if self.part == "synthetic" else f"Real/{self.part}"
        found = []
        for path in self.root.glob(f"*/{pattern}/*/[!.]*.xyz"):
            split, _, sensor, number, _ = path.relative_to(self.root).parts
            cls, name = class_of(number, classes, path), f"{sensor}_{path.stem}"
            found.append(file_item(path, self.root, cls, split_of(split, path), parse_cloud, name))
        return by_class(found, classes)

    def object_of(self, id_: str) -> str:
        """See `Importer`: each class is one object."""
        return id_.split("/")[0]


@settings
class ModelNetMeshes(Importer):
    """ModelNet's CAD meshes, `<class>/{train,test}/*.off`, sampled here: P points on each surface.

    The folder is that of the unpacked archive, or the root of torch_geometric.datasets.ModelNet,
    which keeps the same tree in `raw/`. Points are uniform on the area, as PyG's SamplePoints and
    PointDA-10 draw them, by a seed of each object. Folders of other classes are left alone.
    """

    seed: Annotated[int, Ge(0)] = 0

    holds: ClassVar[str] = "*/train/*.off"
    made: ClassVar[MadeOf] = MadeOf(objects="ModelNet's published meshes", sensor="surface samples")

    @property
    def root(self) -> Path:
        """See `Importer`."""
        folder = super().root
        return folder / "raw" if (folder / "raw").is_dir() else folder

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`. By split, in it by class, in it by name."""
        found = []
        for path, cls, split in _tree(self.root, (".off",), lambda name: known_as(name, classes)):
            seed = derive(self.seed, "modelnet surface", cloud_id(cls, split, path.stem))
            load = functools.partial(sample_file, points=self.points, seed=seed)
            item = file_item(path, self.root, cls, split, load)
            found.append(item._replace(row=dataclasses.replace(item.row, seed=seed)))
        return by_class(found, classes)


@settings
class ArrayFiles(Importer):
    """Clouds in a few files, several in each; those of classes that are not wanted are left out."""

    ordered: ClassVar[bool] = False
    """Whether the clouds keep the order of the files; else split, class and name order them."""

    @abc.abstractmethod
    def parts(self) -> list[tuple[str, Path]]:
        """The split ("" of a file that has several) and the path of each file, in order."""

    @abc.abstractmethod
    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """The clouds of a file, in its order."""

    def files(self) -> list[Path]:
        """See `Importer`."""
        return [path for _, path in self.parts()]

    def items(self, classes: Sequence[str]) -> list[Item]:
        """See `Importer`; reads the files."""
        found = []
        for of_file, path in self.parts():
            for i, (cls, split, name, cloud) in enumerate(self.clouds(path, of_file, classes)):
                if cls in classes:
                    id_, origin = cloud_id(cls, split, name), f"{path.name}[{i}]"
                    row = ManifestRow(id_, cls, split, origin=origin)
                    found.append(Item(row, functools.partial(np.asarray, cloud)))
        return found if self.ordered else by_class(found, classes)


@settings
class NamedArrays(ArrayFiles):
    """One .npz with arrays `points` [N, P, 3], `cls` [N], `split` [N] and `name` [N]."""

    file: str = "points.npz"

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        return MadeOf(objects=f"arrays of {self.file}")

    def parts(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`."""
        return [("", self.root / self.file)]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        for cloud, cls, split, name in zip(*named_arrays(path).values(), strict=True):
            yield class_of(str(cls), classes, path), split_of(str(split), path), str(name), cloud


@settings
class PointDAH5(ArrayFiles):
    """PointDA-10's ScanNet10: `train_0.h5 train_1.h5 train_2.h5 test_0.h5`.

    Each holds `data` [n, 2048, 6] (x y z in metres with y up, floor at 0; then rgb) and `label`
    [n] in the order of `qs3.classes`. The extraction stored (X, Z, Y) of ScanNet's (X, Y, Z): two
    axes were swapped, so after turning y to z every object is the mirror image of the real one (y
    is negated). All published numbers were measured on the mirror images.
    """

    form: Literal["real", "mirrored"] = "real"
    ordered: ClassVar[bool] = True

    def made_of(self) -> MadeOf:
        """See `Importer`."""
        if self.form == "real":  # published figures were measured on mirror images
            return MadeOf(objects="published files, no longer mirrored")
        return MadeOf(objects="published files", published=True)

    def parts(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`: all that there are, at least one a split."""
        names = {s: sorted(self.root.glob(f"{s}_*.h5")) for s in ("train", "test")}
        return [(s, p) for s in names for p in names[s] or [self.root / f"{s}_0.h5"]]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        return read_h5(path, split, classes, digits=4)

    def turn(self, cloud: np.ndarray, cls: str) -> np.ndarray:
        """See `Importer`."""
        cloud = turned(cloud, "y")
        return cloud * _MIRROR if self.form == "real" else cloud


@settings
class ScanObjectNN(ArrayFiles):
    """ScanObjectNN (Uy et al., ICCV 2019): objects segmented from real scans, 15 classes.

        main_split/{training,test}_objectdataset.h5                          objects as segmented
        main_split/{training,test}_objectdataset_augmentedrot_scale75.h5     PB_T50_RS, the hardest
        main_split_nobg/...                                                  without background

    Each file holds `data` [n, 2048, 3] with y up and `label` [n]. Seven of its classes are ours;
    the clouds of the others are left out. bathtub, lamp and plant are not in it.

    Attributes:
        variant: what follows `_objectdataset` in the files' names, e.g. "_augmentedrot_scale75".
    """

    variant: str = ""
    up: ClassVar[str] = "y"

    def parts(self) -> list[tuple[str, Path]]:
        """See `ArrayFiles`."""
        name = f"objectdataset{self.variant}.h5"
        return [("train", self.root / f"training_{name}"), ("test", self.root / f"test_{name}")]

    def clouds(self, path: Path, split: str, classes: Sequence[str]) -> Iterator[Cloud]:
        """See `ArrayFiles`."""
        return read_h5(path, split, SCANOBJECTNN, digits=5)


def named_arrays(path: Path) -> dict[str, np.ndarray]:
    """points, cls, split and name; DataError if damaged, missing, or of different lengths."""
    arrays = read_arrays(path, ("points", "cls", "split", "name"))
    with reading(path):
        assert len({*map(len, arrays.values())}) == 1, "its arrays have different lengths"
        assert arrays["points"].shape[2:] == (3,), f"points of shape {arrays['points'].shape}"
    return arrays


def sample_file(path: Path, points: int, seed: int) -> np.ndarray:
    """[points, 3] float32, uniform on the surface of a mesh file, in its axes and units."""
    from qs3.geometry.sampling import surface_sample
    from qs3.meshes.io import load_mesh

    with reading(path):
        mesh = load_mesh(path)
        cloud = surface_sample(mesh.vertices, mesh.faces, points, np.random.default_rng(seed))
    return cloud.astype(np.float32)


def _tree(
    root: Path, suffixes: Sequence[str], class_named: Callable[[str], str | None]
) -> Iterator[tuple[Path, str, str]]:
    """Path, class and split of all files `root/<class>/<split>/*` with one of the suffixes.

    Hidden files, other extensions, and folders of no class (None) are passed over.
    """
    for path in sorted(root.glob("[!.]*/[!.]*/[!.]*")):
        split = path.parent
        if path.suffix.lower() in suffixes and (cls := class_named(split.parent.name)) is not None:
            yield path, cls, split_of(split.name, split)


def read_h5(path: Path, split: str, names: Sequence[str], digits: int) -> Iterator[Cloud]:
    """The clouds of one file, float32, axes as stored; `names` of the classes by label."""
    import h5py

    with reading(path), h5py.File(path, "r") as file:
        data = np.asarray(file["data"][..., :3], dtype=np.float32)
        labels = np.asarray(file["label"][...], dtype=np.int64).reshape(-1)
        assert len(labels) == len(data), f"{len(data)} clouds and {len(labels)} labels"
        assert ((labels >= 0) & (labels < len(names))).all(), f"labels not 0..{len(names) - 1}"
    for number, (cloud, label) in enumerate(zip(data, labels.tolist(), strict=True)):
        yield names[label], split, f"{path.stem}_{number:0{digits}d}", cloud
