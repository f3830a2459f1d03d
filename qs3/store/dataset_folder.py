"""The names of what lies in a dataset's folder next to the store's own files, and deleting it all.

recipe.json   what the parts were made with; another recipe is refused
parts/        one file an object or scene, until the store is written
views/        images and depths of every view, if they were asked for
clouds.png, infrared.png, config.yaml
costs.csv     seconds of each object, and the most memory that its process had taken by then
"""

from __future__ import annotations

import shutil
from pathlib import Path

from qs3.errors import DataError
from qs3.store.made_of import MadeOf
from qs3.store.store import is_finished, read_meta

RECIPE, PARTS, VIEWS = "recipe.json", "parts", "views"
CLOUDS, INFRARED, CONFIG, COSTS = "clouds.png", "infrared.png", "config.yaml", "costs.csv"


def check_ours(folder: Path, command: str, elsewhere: str) -> None:
    """Refuse to make a dataset where a finished one lies that has no recipe: it was imported.

    Args:
        folder: of the dataset.
        command: that would replace it, for the message.
        elsewhere: its setting that names another folder.

    Raises:
        DataError: says what is there.
    """
    if is_finished(folder) and not (folder / RECIPE).is_file():
        raise DataError(
            f"{folder} holds a dataset that {command} did not make "
            f"({MadeOf.of(read_meta(folder))}) and never replaces, not with force=true either; "
            f"give another {elsewhere}, or delete the folder if nobody needs it"
        )


def delete_dataset(folder: Path) -> None:
    """Delete a dataset, finished or not, and its recipe; other files are left alone."""
    # meta.yaml first: without it the folder counts as unfinished whatever else is left. The
    # recipe last: as long as a part is left, it says what the part was made with.
    (folder / "meta.yaml").unlink(missing_ok=True)
    for name in (PARTS, VIEWS):
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
    names = ("manifest.csv", CLOUDS, INFRARED, CONFIG, COSTS)
    for path in [*(folder / name for name in names), *folder.glob("*.npy"), folder / RECIPE]:
        path.unlink(missing_ok=True)
