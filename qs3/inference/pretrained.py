"""The classifiers that come with qs3, by name: folders of `qs3.inference.model_folder`.

    qs3.load("dgcnn-speckle")
    qs3 predict input=SCANS            # without ckpt=: chosen by `usual`

Each has a card, README.md, that says what it learnt from, by which commands, and what it was found
to be worth. None has seen a real scan.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "pretrained"

ANY_SIZE, HEIGHTS = "dgcnn-speckle", "dgcnn-rooms"
"""What is used where nobody names one: for clouds of any unit and place, and for those in metres of
which it is known where the floor is."""

SECOND = "pointnet-speckle"
"""What is asked beside these: another net, which errs otherwise."""


def names() -> list[str]:
    """Of all of them."""
    return sorted(path.parent.name for path in FOLDER.glob("*/config.json"))


def folder_of(name: str | Path) -> Path | None:
    """The folder of one; None if there is none of this name, or something else has it here."""
    return FOLDER / name if str(name) in names() and not Path(name).exists() else None


def name_of(file: Path) -> str | None:
    """Whose file of weights that is; None: of none of them."""
    folder = file.resolve().parent
    return folder.name if folder.parent == FOLDER and folder.name in names() else None


def other_than(name: str) -> str:
    """Which one is asked beside it where nobody names one; "none" if there is no other net."""
    return SECOND if name != SECOND and SECOND in names() else "none"


def usual(floor_known: bool) -> str:
    """Which one is used where nobody names one; `floor_known`: said, or seen in the clouds."""
    return HEIGHTS if floor_known else ANY_SIZE
