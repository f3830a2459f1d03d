"""`qs3 scannet`: DepthScanNet10 from raw ScanNet."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Gt


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
    engine: Annotated[Literal["local", "ray", "slurm"], "on which machines"] = "local",
    force: Annotated[bool, "delete the dataset at out first"] = False,
    points: Annotated[int, Ge(1), "of a cloud (farthest point sampling)"] = 2048,
    min_points: Annotated[
        int, Ge(0), "a frame counts if it shows more points of the object"
    ] = 1000,
    views: Annotated[int, Ge(1), "frames fused, far from each other in direction"] = 10,
    stride: Annotated[
        int, Ge(1), "look at every n-th frame only; 10 takes a tenth of the time"
    ] = 1,
    depth_min_m: Annotated[float, Gt(0), "nearer depths are left out"] = 0.1,
    depth_max_m: Annotated[float, Gt(0), "farther depths are left out"] = 10.0,
    margin_px: Annotated[int, Ge(0), "pixels around that must show the same object, too"] = 1,
    column: Annotated[Literal["category", "raw_category"], "of the label map"] = "category",
    **more: Annotated[str, "settings of conf/engine/ray.yaml or slurm.yaml: engine.address=auto"],
) -> None:
    r"""DepthScanNet10 from raw ScanNet: objects cropped from the depth images.

    Accept ScanNet's terms of use first, http://www.scan-net.org. Defaults are those of the paper
    where it names one. Run the same command again after an interruption: it continues. Scenes that
    failed (scenes.csv says why) or came later are then extracted and added.

    Example:
        qs3 scannet scans=SCANNET/scans labels=SCANNET/scannetv2-labels.combined.tsv \
            train=SCANNET/scannetv2_train.txt val=SCANNET/scannetv2_val.txt \
            out=data/depthscannet10
    """  # fmt: skip
    from qs3.cluster import pool_of
    from qs3.datasets.scannet import extract
    from qs3.datasets.scannet_scene import Extraction

    settings = Extraction(
        points, min_points, views, stride, depth_min_m, depth_max_m, margin_px, column
    )
    words = [f"{key}={value}" for key, value in more.items()]
    pool = pool_of(engine, workers, words, out.absolute().parent)
    extract(
        scans=scans, labels=labels, train=train, val=val, out=out, settings=settings, force=force,
        pool=pool,
    )  # fmt: skip
