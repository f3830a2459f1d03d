"""What can be downloaded, what it is for, and under which terms.

The files on Google Drive are those that the README of QS3 links; sizes and hashes were not
published. The addresses of ModelNet are asked of PyG's dataset, so that there is one list of them.
"""

from __future__ import annotations

from dataclasses import dataclass

from qs3.data.download import drive
from qs3.data.download.layouts import GRASPNET, POINTDA_H5, TREE, Layout
from qs3.errors import ConfigError

_MODELNET = "academic research only (https://modelnet.cs.princeton.edu)"
_MIT = "published by the authors of QS3; made from ModelNet: academic research only"
_SCANNET = "made from ScanNet: its terms of use must be accepted first"


def _tree(suffix: str, named: str = "") -> Layout:
    holds = TREE.replace("{suffix}", f"(?i:{suffix})")
    return Layout(holds, f"<class>/{{train,test}}/*.{suffix}", named)


@dataclass(frozen=True)
class Part:
    """One folder of an archive, and where it goes.

    Attributes:
        folder: below `<data_dir>/published`.
        layout: how to find it in the archive.
        domains: that read it, as on the command line.
    """

    folder: str
    layout: Layout
    domains: tuple[str, ...] = ()


@dataclass(frozen=True)
class Source:
    """One archive that somebody publishes.

    Attributes:
        name: as on the command line.
        title: in a sentence.
        file: its name in the folder of downloads and on a mirror; the kind of archive is found
            out from its first bytes.
        terms: of use.
        parts: what is taken from it.
        drive_id: on Google Drive, or "".
        pyg: name of PyG's ModelNet dataset that knows the address, or "".
        agreement: what must be given as accept_terms= first, or "".
        size: in bytes where it is known, else None.
        size_says: for people.
    """

    name: str
    title: str
    file: str
    terms: str
    parts: tuple[Part, ...]
    drive_id: str = ""
    pyg: str = ""
    agreement: str = ""
    size: int | None = None
    size_says: str = "not known beforehand"

    @property
    def domains(self) -> tuple[str, ...]:
        """All that its parts are for."""
        return tuple(domain for part in self.parts for domain in part.domains)

    def url(self, mirror: str = "", drive_server: str = drive.SERVER) -> str:
        """Where the file is; with `mirror`, under its own name there."""
        if mirror:
            return f"{mirror.rstrip('/')}/{self.file}"
        return drive.address(self.drive_id, drive_server) if self.drive_id else pyg_url(self.pyg)


def pyg_url(name: str) -> str:
    """The address of ModelNet"10" or "40" as torch_geometric.datasets.ModelNet has it."""
    from torch_geometric.datasets import ModelNet  # seconds: asked only when it is needed

    return str(ModelNet.urls[name])


SOURCES: tuple[Source, ...] = (
    Source(
        "modelnet40_off",
        "ModelNet40, the CAD meshes as published (12,311 .off files, 40 classes)",
        "ModelNet40.zip",
        _MODELNET,
        (Part("modelnet40/raw", _tree("off"), ("modelnet10_meshes", "modelnet40_meshes")),),
        pyg="40",
        size_says="about 2 GB; unpacked several times as much",
    ),
    Source(
        "modelnet10_off",
        "ModelNet10, the CAD meshes as published (4,899 .off files; its ten classes are not those "
        "of the benchmark)",
        "ModelNet10.zip",
        _MODELNET,
        (Part("modelnet10_off/raw", _tree("off")),),
        pyg="10",
        size=473_402_300,
        size_says="0.47 GB; unpacked several times as much",
    ),
    Source(
        "modelnet10",
        "M: the ten classes of PointDA-10 from ModelNet40, 2,048 points (QS3's copy)",
        "modelnet10.zip",
        _MODELNET,
        (Part("modelnet10", _tree("npy"), ("modelnet10",)),),
        drive_id="1OcPHRtAznBev53PK9sPupNZI1p6-gu2_",
    ),
    Source(
        "specklenet10",
        "S: SpeckleNet10",
        "specklenet10.zip",
        _MIT,
        (Part("specklenet10", _tree("xyz"), ("specklenet10",)),),
        drive_id="1RX_gridSacIs4xp58zoZ2yTtajEF2kzu",
    ),
    Source(
        "specklenet40",
        "SpeckleNet40, the same for all classes of ModelNet40",
        "specklenet40.zip",
        _MIT,
        (Part("specklenet40", _tree("xyz"), ("specklenet40",)),),
        drive_id="1SEyOjtV-2wr1eYWxU6mivOD9NRB2Qz35",
    ),
    Source(
        "modelnet40_obj",
        "ModelNet40_OBJ: the meshes as QS3's renderer read them (for generate.py meshes=)",
        "modelnet40_obj.zip",
        _MODELNET,
        (Part("modelnet40_obj", _tree("obj")),),
        drive_id="1WzCYS1HfUKij0hpSzkhfd8uWd2uEP26-",
    ),
    Source(
        "depthscannet10",
        "D: DepthScanNet10, the clouds that the authors of QS3 published",
        "depthscannet10.zip",
        _SCANNET,
        (Part("depthscannet10", _tree("xyz"), ("depthscannet10",)),),
        drive_id="1gWf5X8HVt0cFpDf-I-lpoqrOBc_kqVL-",
        agreement="scannet",
    ),
    Source(
        "scannet10",
        "S*: PointDA-10's ScanNet10 (QS3's copy)",
        "scannet10.zip",
        _SCANNET,
        (
            Part(
                "scannet10",
                Layout(POINTDA_H5, "train_*.h5 and test_*.h5", at_least=2),
                ("scannet10",),
            ),
        ),
        drive_id="1L2l67Wop1Mvw2yIxufxmm5i82qJKoF7B",
        agreement="scannet",
    ),
    Source(
        "pointda10",
        "PointDA-10: ModelNet10, ShapeNet10 and ScanNet10 in one archive",
        "pointda10.zip",
        "its parts have the terms of ModelNet, ShapeNet and ScanNet; ScanNet's must be accepted "
        "first",
        (
            Part("modelnet10", _tree("npy", "modelnet[^/]*"), ("modelnet10",)),
            Part("shapenet10", _tree("npy", "shapenet[^/]*"), ("shapenet10",)),
            Part(
                "scannet10",
                Layout(POINTDA_H5, "train_*.h5 and test_*.h5", "scannet[^/]*", at_least=2),
                ("scannet10",),
            ),
        ),
        drive_id="1-LfJWL5geF9h0Z2QpdTL0n4lShy8wy2J",
        agreement="scannet",
    ),
    Source(
        "graspnetpc10",
        "GraspNetPC-10: single views of ten objects, synthetic and by two real sensors",
        "graspnetpc10.zip",
        "made from GraspNet-1Billion: non-commercial (https://graspnet.net)",
        (
            Part(
                "graspnetpc10",
                Layout(GRASPNET, "{train,test}/{Real,Synthetic}/<camera>/<0-9>/*.xyz"),
                ("graspnetpc10",),
            ),
        ),
        drive_id="1VVHmsSToFMVccge-LsYJW67IS94rNxWR",
    ),
)

BY_HAND: dict[str, str] = {
    "scannet": """\
Raw ScanNet (.sens files, masks) is given to those who signed its terms of use, and is never
downloaded from here.
  1. Read and sign http://kaldir.vc.in.tum.de/scannet/ScanNet_TOS.pdf, and send it from an address
     of your institution to scannet@googlegroups.com; the answer holds the authors' download script.
  2. With it, fetch of every scene: .sens, _2d-instance-filt.zip, _2d-label-filt.zip and
     .aggregation.json, and scannetv2-labels.combined.tsv. All scenes take about 1.3 TB.
  3. scannetv2_train.txt and scannetv2_val.txt are in Tasks/Benchmark of github.com/ScanNet/ScanNet.
  4. qs3 scannet --help   tells how to make DepthScanNet10 (D) from them.""",
    "shapenet": """\
ShapeNet's meshes are given to those who sign up at https://shapenet.org (non-commercial research
and education). The benchmark's ShapeNet10 are points sampled on them: they are in PointDA-10,
  qs3 download pointda10
or put them yourself so that <data_dir>/published/shapenet10 holds
<class>/{train,validation,test}/*.npy ([1024, 3], y up).""",
    "scanobjectnn": """\
ScanObjectNN is given to those who fill in the form at https://hkust-vgd.github.io/scanobjectnn/
(its terms are shown there; its scans come from SceneNN and ScanNet, whose terms hold, too).
Unpack h5_files.zip so that <data_dir>/published/scanobjectnn holds main_split/*.h5 and
main_split_nobg/*.h5; domain scanobjectnn reads them.""",
}
"""What has to be fetched by hand, and how."""

AGREEMENTS: dict[str, str] = {
    "scannet": """\
{title}
was made from ScanNet, and its clouds fall under ScanNet's terms of use:
  http://kaldir.vc.in.tum.de/scannet/ScanNet_TOS.pdf   (non-commercial research and education)
The clouds lie open on Google Drive, where their authors put them; that does not release you from
those terms. Read and sign them, send them to scannet@googlegroups.com, and then say that you have:
  qs3 download {name} accept_terms=scannet
Instead of these clouds, D can be made from raw ScanNet: qs3 download scannet""",
}
"""What is printed before an agreement is given, by the word of `accept_terms=`."""


def find(name: str) -> Source:
    """The source of this name.

    Raises:
        ConfigError: there is none; lists them.
    """
    for source in SOURCES:
        if source.name == name:
            return source
    known = ", ".join([*(source.name for source in SOURCES), *BY_HAND])
    raise ConfigError(f"{name!r} is nothing that can be downloaded; known are {known}")
