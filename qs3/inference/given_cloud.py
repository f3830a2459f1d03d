"""What somebody gives to `predictor([cloud])`, as an array [n, 3]."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from qs3.datasets.clouds import check_shape, checked
from qs3.errors import DataError
from qs3.utils.plural import counted


def given_cloud(cloud: Any, name: str) -> Float[np.ndarray, "n 3"]:
    """The x y z of an array, tensor or nested list [n, >= 3] of numbers.

    Args:
        cloud: any n >= 1.
        name: of it, for messages.

    Raises:
        DataError: something else, no points, or NaN, infinite or masked coordinates; says which.
            Or several points that are (0, 0, 0), which stand for no measurement.
    """
    found = _array(cloud, name)
    if found.ndim != 2 or found.shape[1] < 3:
        raise DataError(f"{name}: the array has shape {found.shape}, expected [n, 3]")
    check_shape(name, found.shape)
    if isinstance(cloud, np.ma.MaskedArray):  # numpy would hand on what it hides
        masked = int(np.ma.getmaskarray(cloud)[:, :3].any(axis=1).sum())
        if masked:
            raise DataError(
                f"{name}: {counted(masked, 'point is', 'points are')} masked; leave such points "
                "out: numpy.ma.compress_rows(cloud)"
            )
    zeros = int((found[:, :3] == 0).all(axis=1).sum())
    if zeros > 1:  # one may be a shape's own
        raise DataError(
            f"{name}: {zeros} points are (0, 0, 0), as depth cameras write pixels without depth; "
            "leave such points out: cloud[cloud[:, :3].any(axis=1)]"
        )
    return checked(found[:, :3], name)


def _array(cloud: Any, name: str) -> np.ndarray:
    if isinstance(cloud, Tensor):
        cloud = cloud.detach().cpu()
    try:
        found = np.asarray(cloud)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise DataError(f"{name}: no array of numbers [n, 3] ({error})") from error
    if found.dtype.kind not in "fiu":
        raise DataError(f"{name}: {type(cloud).__name__} of {found.dtype}, no numbers [n, 3]")
    return found
