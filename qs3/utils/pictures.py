"""How large a picture is, by its header alone: unpacked, 91 bytes can be gigabytes."""

from __future__ import annotations

import warnings
from pathlib import Path

from qs3.errors import DataError


def check_picture(path: Path, most: int) -> None:
    """Refuse a picture that cannot be opened, or of more than `most` pixels.

    Raises:
        DataError: names the file.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                width, height = picture.size
    except Image.DecompressionBombError:
        width, height = most + 1, 1
    except Exception as error:  # of a dozen kinds, by format
        raise DataError(f"{path} is not an image, or damaged: {error}") from error
    if width * height > most:
        raise DataError(f"{path} has more than {most / 1e6:.3g} million pixels; refused")
