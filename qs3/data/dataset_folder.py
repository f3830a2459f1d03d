"""The names of what lies in a dataset's folder next to the store's own files, and deleting it all.

recipe.json   what the parts were made with; another recipe is refused
parts/        one file an object or scene, until the store is written
views/        images and depths of every view, if they were asked for
clouds.png, infrared.png, config.yaml
"""

from __future__ import annotations

import shutil
from pathlib import Path

RECIPE, PARTS, VIEWS = "recipe.json", "parts", "views"
CLOUDS, INFRARED, CONFIG = "clouds.png", "infrared.png", "config.yaml"


def delete_dataset(folder: Path) -> None:
    """Delete a dataset, finished or not, and its recipe; other files are left alone."""
    # meta.yaml first: without it the folder counts as unfinished whatever else is left. The
    # recipe last: as long as a part is left, it says what the part was made with.
    (folder / "meta.yaml").unlink(missing_ok=True)
    for name in (PARTS, VIEWS):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    names = ("manifest.csv", CLOUDS, INFRARED, CONFIG)
    for path in [*(folder / name for name in names), *folder.glob("*.npy"), folder / RECIPE]:
        path.unlink(missing_ok=True)
