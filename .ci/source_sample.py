"""Write qs3/pretrained/source_sample.npz: some clouds of finished datasets, thinned, for training.

    python .ci/source_sample.py out=qs3/pretrained/source_sample.npz data/sample_kinect data/...

docs/reference/pretrained.md has the commands that make the datasets. Clouds become the 512 points
that training would draw of them (farthest points from the first one on), in 16 bits: within 2 mm of
what they were.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from qs3.datamodules.fps_samples import sample
from qs3.store.meta import OK, read_manifest
from qs3.store.store import open_pointset

POINTS = 512


def main(out: Path, folders: list[Path]) -> None:
    """All clouds of the datasets, as training clouds."""
    found: dict[str, list] = {"points": [], "cls": [], "split": [], "name": []}
    for folder in folders:
        data = open_pointset(folder)
        rows = [row for row in read_manifest(folder, data.classes) if row.status == OK]
        clouds = np.asarray(data.points)
        order = sample(clouds, POINTS, 1)[:, 0]
        thin = np.take_along_axis(clouds, order[..., None].astype(np.int64), axis=1)
        found["points"] += [*thin.astype(np.float16)]
        found["cls"] += [row.cls for row in rows]
        found["split"] += ["train"] * len(rows)
        found["name"] += [f"{row.id.rpartition('/')[2]}_{folder.name}" for row in rows]
    np.savez_compressed(out, **{key: np.array(values) for key, values in found.items()})
    print(f"{out}: {len(found['cls'])} clouds, {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    given = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    main(Path(given["out"]), [Path(word) for word in sys.argv[1:] if "=" not in word])
