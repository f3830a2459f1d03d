"""`qs3 scannet`: DepthScanNet10 from raw ScanNet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from annotated_types import Ge


def scannet(
    *,
    scans: Annotated[
        Path,
        "folder of scenes; in scene0000_00/ lie scene0000_00.sens, "
        "scene0000_00_2d-instance-filt.zip, scene0000_00_2d-label-filt.zip and "
        "scene0000_00.aggregation.json; the zips stay zips; 1.3 TB for all scenes",
    ],
    labels: Annotated[Path, "scannetv2-labels.combined.tsv, from the same download"],
    train: Annotated[
        Path, "scannetv2_train.txt, from Tasks/Benchmark of github.com/ScanNet/ScanNet"
    ],
    val: Annotated[Path, 'scannetv2_val.txt, from there too; becomes the split "test"'],
    out: Annotated[
        Path, "folder of the dataset; domain=depthscannet10 expects data/depthscannet10"
    ],
    workers: Annotated[int, Ge(0), "processes; their number changes no byte"] = 1,
    **more: Annotated[
        str,
        "fields of qs3.datasets.scannet.ScanNet: min_points=1000 views=10 stride=1 on_error=skip",
    ],
) -> None:
    r"""DepthScanNet10 from raw ScanNet: objects cropped from the depth images.

    Accept ScanNet's terms of use first, http://www.scan-net.org. Defaults are those of the paper
    where it names one. Run the same command again after an interruption, or when a damaged scene
    is mended: it continues. on_error=skip leaves damaged scenes out, and manifest.csv says why.

    Example:
        qs3 scannet scans=SCANNET/scans labels=SCANNET/scannetv2-labels.combined.tsv \
            train=SCANNET/scannetv2_train.txt val=SCANNET/scannetv2_val.txt \
            out=data/depthscannet10
    """
    from qs3.classes import CLASSES
    from qs3.config.hydra import build
    from qs3.datasets.importing import import_into

    lists = {"labels": labels, "train": train, "val": val}
    importer = build(
        {
            "_target_": "qs3.datasets.scannet.ScanNet",
            "folder": str(scans),
            "workers": workers,
            **{key: str(path.absolute()) for key, path in lists.items()},
            **more,
        }
    )
    import_into(out, importer, name=out.name, classes=CLASSES)
