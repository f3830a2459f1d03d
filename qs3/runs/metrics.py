"""The schema of `metrics.json`: what a finished run reports. Training makes it, all else reads it.

Shares and accuracies are in [0, 1]. A figure that does not exist is null: without labels of the
target there is no accuracy, and of a net that has diverged there is no finite score.
"""

from dataclasses import field
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict, TypeAdapter
from pydantic.dataclasses import dataclass

from qs3.store.meta import MadeOf
from qs3.utils.files import reading, write_text

METRICS = "metrics.json"

_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Scores:
    """What a net is worth on n evaluated clouds; see `qs3.evaluation.metrics.scores`.

    `predicted` counts what was given to each class, in label order, `confusion[i][j]` clouds of
    class i predicted as j. All else is None without labels.
    """

    n: int
    predicted: dict[str, int]
    accuracy: float | None = None
    balanced_accuracy: float | None = None
    majority_rate: float | None = None
    per_class_recall: dict[str, float | None] | None = None
    confusion: list[list[int]] | None = None
    calibration_error: float | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class EpochScores:
    """Scores of the weights at the end of an epoch (from 0)."""

    epoch: int
    scores: Scores


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Warmup:
    """The teacher of round 0, and the warm-up's last epoch."""

    selected: EpochScores
    last: EpochScores


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Selection:
    """By which rule teacher and student were chosen, with the epoch."""

    teacher: str
    student: str


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Loading:
    """Points of a cloud, its scale, samples of each, and how source clouds are drawn."""

    points: int
    scale: str
    fps_starts: int
    sampler: str


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Evaluated:
    """On what, and how, the scores were taken.

    Attributes:
        split: "test"; "train" where there is no other.
        labels: whether the clouds' classes are known.
        norms: as `evaluation.norms`.
        prior, prior_shares: how common classes counted as, in words and as numbers of sum 1.
        tiers: the final scores of the clouds of each tier ("clean", "hard": how much of the object
            is seen), where these and labels are known.
    """

    split: str
    labels: bool
    norms: str
    prior: str = ""
    prior_shares: dict[str, float] | None = None
    tiers: dict[str, Scores] | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class PseudoLabelScores:
    """How right a round's pseudo-labels were; computed after training, nothing is chosen by it."""

    precision: float
    recall: float
    accuracy: float


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RoundRecord:
    """One round of self-training, from 0; target clouds by class, and of all classes.

    `mu` and `thresholds` are by class, where the selector has them; `missing_classes` have no
    pseudo-label; `agreement` is the share of labels as in the round before.
    """

    round: int
    theta: float
    confident: dict[str, int]
    selected: dict[str, int]
    mu: dict[str, float] | None = None
    thresholds: dict[str, float] | None = None
    total_confident: int
    total_selected: int
    missing_classes: list[str]
    agreement: float | None
    with_target_labels: PseudoLabelScores | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Quality:
    """What can be estimated of the reported net on the evaluated clouds without their labels.

    Attributes:
        validation_accuracy: on held-out labelled clouds.
        unlike_source: share of clouds outside the usual range of the labelled ones.
        never_predicted: classes.
    """

    validation_accuracy: float
    unlike_source: float
    never_predicted: list[str]


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class DataHashes:
    """`PointSet.sha256` of both datasets; the source's is the target's for `method=supervised`."""

    source: str
    target: str


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class DataMadeOf:
    """What both datasets are made of."""

    source: MadeOf
    target: MadeOf


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class Times:
    """What the run took, over all of its starts: wall time, processor time, most memory."""

    seconds: float
    core_seconds: float | None = None
    memory_gb: float | None = None
    gpu_memory_gb: float | None = None


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class RunMetrics:
    """`metrics.json`.

    Attributes:
        source, target: names of the domains; source is the target for `method=supervised`.
        simulated: whether the target is.
        final: the reported scores: the student's, without rounds the warm-up's.
        infomax: see `qs3.evaluation.validators`; None of a net that has diverged.
        versions: of the software that began the run.
    """

    experiment: str
    hash: str
    config_sha256: str
    seed: int
    status: Literal["finished"] = "finished"
    source: str
    target: str
    simulated: bool
    method: str
    selftraining: str
    model: str
    selection: Selection
    loading: Loading
    final: Scores
    evaluation: Evaluated
    warmup: Warmup
    rounds: list[RoundRecord] = field(default_factory=list)
    infomax: float | None
    quality: Quality
    data: DataHashes
    made_of: DataMadeOf
    times: Times
    versions: dict[str, str]

    @property
    def diverged(self) -> bool:
        """Whether the predictions are not numbers: every cloud is of class 0 then."""
        return self.infomax is None

    @property
    def seen(self) -> dict[str, str]:
        """SHA-256 of all that it was trained on; "" of what it had none of."""
        return {
            "source": self.data.target if self.method == "supervised" else self.data.source,
            "target": self.data.target,
            "weights": self.versions.get("weights", "").rpartition(" ")[2],
        }

    @property
    def target_text(self) -> str:
        """The target's name, with "(simulated)" where that is so."""
        return f"{self.target}{' (simulated)' if self.simulated else ''}"

    @property
    def domains(self) -> dict[str, MadeOf]:
        """By name what each domain is made of, the source first; only one if they are the same.

        Two of one name, as of two folders of own clouds, are distinguished by what they are for.
        """
        source, target = self.made_of.source, self.made_of.target
        if self.source == self.target and source != target and self.method != "supervised":
            return {f"{self.source} (source)": source, f"{self.target} (target)": target}
        return {self.source: source, self.target: target}

    @property
    def data_text(self) -> str:
        """Such as "specklenet10 (embedded catalogue, ...), depthscannet10 (published files)"."""
        return ", ".join(f"{name} ({made})" for name, made in self.domains.items())


_SCHEMA: TypeAdapter[RunMetrics] = TypeAdapter(RunMetrics)


def read_metrics(folder: str | Path) -> RunMetrics | None:
    """The result of a finished run; None if the run is not finished."""
    path = Path(folder) / METRICS
    if not path.exists():
        return None
    with reading(path):
        return _SCHEMA.validate_json(path.read_bytes())


def write_metrics(folder: str | Path, metrics: RunMetrics) -> None:
    """Save the result, atomically, which also marks the run as finished."""
    write_text(Path(folder) / METRICS, _SCHEMA.dump_json(metrics, indent=2).decode() + "\n")
