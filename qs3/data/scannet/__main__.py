"""DepthScanNet10 from raw ScanNet: objects of ten classes, cropped from the depth images.

    python -m qs3.data.scannet scans=PATH labels=PATH train=PATH val=PATH out=PATH
                               [workers=2] [stride=1] [force=false] [SETTING=VALUE ...]

What you need (accept ScanNet's terms of use first, http://www.scan-net.org):
  scans=   folder of scenes; in scene0000_00/ lie scene0000_00.sens,
           scene0000_00_2d-instance-filt.zip, scene0000_00_2d-label-filt.zip and
           scene0000_00.aggregation.json. The zips stay zips; about 1.3 TB for all scenes
  labels=  scannetv2-labels.combined.tsv, from the same download
  train=   scannetv2_train.txt, and val=scannetv2_val.txt, from Tasks/Benchmark of
           github.com/ScanNet/ScanNet. val becomes the split "test", as in PointDA-10
  out=     folder of the dataset; conf/domain/depthscannet10.yaml expects data/depthscannet10

Settings and their defaults, those of the paper where it names one:
  points=2048        of a cloud (farthest point sampling)
  min_points=1000    a frame counts if it shows more points of the object than this
  views=10           frames fused, far from each other in direction; fewer if there are fewer
  stride=1           look at every n-th frame only; 10 takes a tenth of the time
  depth_min_m=0.1 depth_max_m=10   other depths are left out
  margin_px=1        pixels about a mask's pixel that must show the same object, too
  align=false        turn scenes about z by their axisAlignment (needs <scene>.txt)
  column=category    of the label map; or raw_category: the annotators' very words

Run the same command again after an interruption: it continues. Scenes that failed (scenes.csv says
why) or came later are then extracted and added. force=true deletes the dataset at `out` first.
The number of workers changes no byte. Of the memory of a worker, one frame is the most, then the
points of the chosen frames of one scene.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from qs3.errors import ConfigError, Qs3Error

_PATHS = ("scans", "labels", "train", "val", "out")


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit status."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(__doc__)
        return 0
    try:
        arguments = parse(argv)
        from qs3.data.scannet.extraction import extract

        logging.basicConfig(level=logging.INFO, format="%(message)s")
        extract(**arguments)
    except Qs3Error as error:
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; run the same command again and it continues", file=sys.stderr)
        return 130
    return 0


def parse(argv: Sequence[str]) -> dict[str, Any]:
    """key=value words as the arguments of `extract`.

    Raises:
        ConfigError: an unknown key, one that is missing, or a value of the wrong kind.
    """
    from qs3.data.scannet.settings import Extraction

    defaults = {field.name: field.default for field in fields(Extraction)}
    known = {**dict.fromkeys(_PATHS, ""), "workers": 1, "force": False, **defaults}
    found: dict[str, Any] = {}
    for word in argv:
        key, equals, value = word.partition("=")
        if not equals or key not in known:
            raise ConfigError(
                f"unknown argument {word!r}; known are {'=, '.join(known)}= "
                "(python -m qs3.data.scannet --help)"
            )
        found[key] = _value(key, value, type(known[key]))
    if missing := [key for key in _PATHS if not found.get(key)]:
        raise ConfigError(
            f"where are {', '.join(missing)}? Give {' '.join(f'{key}=PATH' for key in missing)} "
            "(python -m qs3.data.scannet --help)"
        )
    settings = Extraction(**{key: found.pop(key) for key in defaults if key in found})
    return {**found, **{key: Path(found[key]) for key in _PATHS}, "settings": settings}


def _value(key: str, text: str, kind: type) -> Any:
    if kind is bool:
        if text.casefold() not in ("true", "false"):
            raise ConfigError(f"{key} must be true or false, got {text!r}")
        return text.casefold() == "true"
    try:
        return kind(text)
    except ValueError as error:
        words = {int: "a whole number", float: "a number"}
        raise ConfigError(f"{key} must be {words[kind]}, got {text!r}") from error


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
