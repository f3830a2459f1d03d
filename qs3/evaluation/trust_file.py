"""`trust_weights.json`: the calibration of `qs3.evaluation.trust`, and how far off it was found.

`.ci/trust_fit.py` writes it; docs/results/tried.md has the cases and the figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError

from qs3.errors import DataError
from qs3.utils.files import write_text
from qs3.utils.memory import JSON_PEAK, read_whole

PATH = Path(__file__).with_name("trust_weights.json")

SHIFTS: Mapping[str, str] = {
    "unsure": "the net is less sure than on held-out labelled clouds",
    "thresholded": "fewer answers are as sure as the right ones of held-out labelled clouds",
    "answers": "its answers are unlike those to held-out labelled clouds",
    "shapes": "the clouds are shaped unlike the labelled ones",
    "outside": "clouds lie outside the range of the labelled ones",
    "counts": "classes are named more or less often than on held-out labelled clouds",
    "turns": "rotations about the up axis change more answers",
}
"""By name what each shift of `qs3.evaluation.trust` means, in words."""

_Share = Annotated[float, Field(ge=0, le=1)]
_Weight = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]


def _shifts(value: dict[str, float]) -> dict[str, float]:
    if not value or not set(value) <= {*SHIFTS}:
        raise ValueError(f"should be weights of {', '.join(SHIFTS)}")
    return value


@dataclass(frozen=True)
class Calibration:
    """The weights, and the leave-one-target-out figures of the cases that they were fitted on.

    Attributes:
        weights: by shift, >= 0; see `qs3.evaluation.trust.expected`.
        cases: pairs of a net and a target.
        targets: different ones.
        mean_error: mean of |expected - true accuracy|.
        error_90: nine of ten are not farther off.
        most_too_high: the largest expected - true accuracy.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    weights: Annotated[dict[str, _Weight], AfterValidator(_shifts)]
    cases: Annotated[int, Field(ge=1)]
    targets: Annotated[int, Field(ge=2)]
    mean_error: _Share
    error_90: _Share
    most_too_high: Annotated[float, Field(ge=-1, le=1)]


_SCHEMA: TypeAdapter[Calibration] = TypeAdapter(Calibration)


def read_calibration(path: Path = PATH) -> Calibration:
    """Read and check it.

    Raises:
        DataError: it cannot be read, or is damaged; names the file and the first wrong key.
    """
    try:
        return _SCHEMA.validate_json(read_whole(path, JSON_PEAK))
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror or error}); install qs3 again"
        ) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise DataError(f"{path} is damaged: {place}: {first['msg']}; install qs3 again") from error


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Save it, atomically."""
    write_text(path, _SCHEMA.dump_json(calibration, indent=2).decode() + "\n")
