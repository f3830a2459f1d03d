"""`qs3 download` and `qs3 scannet`: published datasets, put where their domain looks for them."""

import textwrap
from pathlib import Path
from typing import Annotated

from annotated_types import Ge


def download(
    name: Annotated[str, "of the dataset; without it, what there is is listed"] = "",
    *,
    into: Annotated[Path, "the data folder, paths.data_dir of a run"] = Path("data"),
    accept_terms: Annotated[str, "the agreement that you have made, e.g. scannet"] = "",
    archive: Annotated[Path | None, "unpack this, e.g. what your browser downloaded"] = None,
) -> int:
    """Published datasets, put where their domain looks for them.

    Archives come to downloads/ in the data folder, what is in them to published/. What is in place
    is left alone.

    Example:
        qs3 download                              what there is
        qs3 download modelnet40_off
        qs3 download scannet10 accept_terms=scannet into=data
    """
    from qs3.datasets.download import BY_HAND, SOURCES, AgreementError, provide
    from qs3.errors import ConfigError

    if not name:
        print(listing())
        return 0
    if name in BY_HAND:
        print(BY_HAND[name]["how"])
        return 1
    if name not in SOURCES:
        raise ConfigError(f"{name!r} cannot be downloaded; there are {', '.join(SOURCES)}")
    source = SOURCES[name]
    try:
        places = provide(source, into, accept_terms=accept_terms, archive=archive)
    except AgreementError as error:
        print(error)
        return 1
    for part, place in zip(source.parts, places, strict=True):
        used = " and ".join(f"domain={domain}" for domain in part.domains)
        print(f"{place} is there{f', for {used}' if used else ''}")
    return 0


def listing() -> str:
    """All there is to fetch, for people."""
    from qs3.datasets.download import BY_HAND, SOURCES

    lines = ["qs3 download NAME   (--help for more)", ""]

    def add(text: str) -> None:
        lines.extend(textwrap.wrap(text, 96, initial_indent="    ", subsequent_indent="      "))

    for source in SOURCES.values():
        need = f" (accept_terms={source.agreement})" if source.agreement else ""
        lines.append(source.name)
        add(source.title)
        add(f"for {', '.join(f'domain={d}' for d in source.domains) or 'qs3-generate meshes='}")
        add(f"size: {source.size_says}; file: {source.file}; from: {source.page}")
        add(f"terms: {source.terms}{need}")
    lines += ["", "By hand (NAME prints how)"]
    for name, one in BY_HAND.items():
        add(f"{name}, {one['asks']}: {one['terms']}")
    return "\n".join(lines)


def scannet(
    *,
    scans: Annotated[
        Path,
        "folder of scenes; in scene0000_00/ lie scene0000_00.sens, "
        "scene0000_00_2d-instance-filt.zip, scene0000_00_2d-label-filt.zip and "
        "scene0000_00.aggregation.json; the zips stay zips; 1.3 TB for all scenes",
    ],
    labels: Annotated[Path, "scannetv2-labels.combined.tsv, from the same download"],
    train: Annotated[Path, "scannetv2_train.txt, of Tasks/Benchmark of github.com/ScanNet/ScanNet"],
    val: Annotated[Path, 'scannetv2_val.txt, from there too; becomes the split "test"'],
    out: Annotated[Path, "the dataset; domain=depthscannet10 expects data/depthscannet10"],
    workers: Annotated[int, Ge(0), "processes; their number changes no byte"] = 1,
    **more: Annotated[
        str,
        "fields of qs3.datasets.scannet.ScanNet: min_points=1000 views=10 stride=1 on_error=skip",
    ],
) -> None:
    """DepthScanNet10 from raw ScanNet: objects cropped from the depth images.

    Accept ScanNet's terms of use first, http://www.scan-net.org. Defaults are those of the paper
    where it names one. Run the same command again after an interruption, or when a damaged scene
    is mended: it continues. on_error=skip leaves damaged scenes out, and manifest.csv says why.

    Example:
        qs3 scannet scans=SCANS labels=TSV train=TXT val=TXT out=data/depthscannet10
    """
    from qs3.classes import CLASSES
    from qs3.config.hydra import build
    from qs3.datasets.importing import import_into

    lists = {"labels": labels, "train": train, "val": val}
    node = {"_target_": "qs3.datasets.scannet.ScanNet", "folder": str(scans), "workers": workers}
    node |= {key: str(path.absolute()) for key, path in lists.items()}
    importer = build({**node, **more})
    import_into(out, importer, name=out.name, classes=CLASSES)
