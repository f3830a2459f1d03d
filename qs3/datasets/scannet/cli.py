"""`qs3 scannet`: DepthScanNet10 from raw ScanNet."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from qs3.datasets.scannet.settings import Extraction
from qs3.utils.cli import FLAG, NUMBER, Command, Kind, Option, one_of, path, text, whole

_PATHS = {
    "scans": "folder of scenes; in scene0000_00/ lie scene0000_00.sens, "
    "scene0000_00_2d-instance-filt.zip, scene0000_00_2d-label-filt.zip and "
    "scene0000_00.aggregation.json. The zips stay zips; about 1.3 TB for all scenes",
    "labels": "scannetv2-labels.combined.tsv, from the same download",
    "train": "scannetv2_train.txt, from Tasks/Benchmark of github.com/ScanNet/ScanNet",
    "val": 'scannetv2_val.txt, from there too; becomes the split "test", as in PointDA-10',
    "out": "folder of the dataset; conf/domain/depthscannet10.yaml expects data/depthscannet10",
}
_KINDS: dict[type, Kind] = {int: whole(0), float: NUMBER, str: text()}
_SETTINGS = tuple(
    Option(one.name, _KINDS[type(one.default)], one.metadata["help"], one.default)
    for one in fields(Extraction)
)


def _extract(workers: int, engine: str, more: list[str], **given: Any) -> None:
    from qs3.cluster import pool_of
    from qs3.datasets.scannet.extraction import extract

    settings = Extraction(**{option.key: given.pop(option.key) for option in _SETTINGS})
    pool = pool_of(engine, workers, more, given["out"].absolute().parent)
    extract(**given, pool=pool, settings=settings)


SCANNET = Command(
    "qs3 scannet",
    "DepthScanNet10 from raw ScanNet: objects cropped from the depth images",
    _extract,
    (
        *(Option(key, path(), meaning, required=True) for key, meaning in _PATHS.items()),
        Option("workers", whole(0), "processes; their number changes no byte", 1),
        Option("engine", one_of("local", "ray", "slurm"), "on which machines", "local"),
        Option("force", FLAG, "delete the dataset at out first", False),
        *_SETTINGS,
    ),
    (
        "qs3 scannet scans=SCANNET/scans labels=SCANNET/scannetv2-labels.combined.tsv \\",
        "    train=SCANNET/scannetv2_train.txt val=SCANNET/scannetv2_val.txt "
        "out=data/depthscannet10",
    ),
    others={"engine.": "settings of conf/engine/ray.yaml or slurm.yaml: engine.address=auto"},
    about="""
Accept ScanNet's terms of use first, http://www.scan-net.org. Defaults are those of the paper where
it names one.

Run the same command again after an interruption: it continues. Scenes that failed (scenes.csv says
why) or came later are then extracted and added. Of the memory of a worker, one frame is the most,
then the points of the chosen frames of one scene.
""",
)
