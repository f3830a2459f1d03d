"""SD's second step: labels of the target refined by a graph net over its clouds.

Cardace et al., "Self-Distillation for Unsupervised 3D Domain Adaptation", WACV 2023; what the paper
leaves open is as in its released code. Its first step is `qs3.methods.sd`.
"""

from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge, Interval
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from qs3.selftraining.selectors import Selection, TeacherPredictions, doubts, most_confident
from qs3.utils.seeding import derive
from qs3.utils.settings import settings

WIDTH = 128  # of the graph net, and the principal components of the features that it sees
_BLOCK = 1024  # rows of the correlations that are held at once


@settings
class GraphRefined:
    """All target clouds; those most confident by a graph net with its labels and full weight.

    Two clouds are joined if their features' correlation exceeds `correlation` and one is among the
    `neighbours` most correlated of the other. A graph net (`GraphNet`) learns to say, from features
    and the teacher's probabilities, a fifth of them hidden in each step, what the teacher says; of
    each class that it then predicts, the share `growth` x round of its most confident clouds
    (rounded, one at least) get its label. The others keep the teacher's and weigh `unsure`:
    their row of `soft` sums to that, as a cross-entropy is linear in its label (exactly, where
    `protocol.smoothing` is 0). In round 0 that are all, as in the first epochs there.

    Differences to the released code: the graph is undirected, features are reduced to their
    `WIDTH` principal components, who is sure is decided anew each round, and the others' labels are
    those of the present teacher, not of the first one.

    Attributes:
        graph: False refines nothing: the teacher's own probabilities decide (a control).
        growth: of the share, each round, in (0, 1]; 0.05 for rounds of 5 epochs of 100.
        unsure: weight in (0, 1].
        correlation: in [-1, 1).
        neighbours: of a cloud, itself not counted.
        steps: of Adam (1e-3, weight decay 5e-4).
        seed: of the run.
    """

    graph: bool = True
    growth: Annotated[float, Interval(gt=0, le=1)] = 0.05
    unsure: Annotated[float, Interval(gt=0, le=1)] = 0.2
    correlation: Annotated[float, Interval(ge=-1, lt=1)] = 0.95
    neighbours: Annotated[int, Ge(1)] = 10
    steps: Annotated[int, Ge(1)] = 1000
    seed: int = 0

    @property
    def needs_features(self) -> bool:
        """Whether the table must have features."""
        return self.graph

    def select(self, teacher: TeacherPredictions, theta: float, round_: int = 0) -> Selection:
        """As `Selector.select`; chooses all above theta (0 as a rule), with weights in `soft`."""
        assert teacher.probabilities is not None
        n, classes = teacher.probabilities.shape
        sure, labels = np.zeros(n, dtype=bool), teacher.predicted
        if round_:
            scores = self._scores(teacher, round_) if self.graph else teacher.probabilities
            share = min(self.growth * round_, 1.0)
            named = scores.argmax(axis=1)
            sure = most_confident(
                scores.max(axis=1), named, share, teacher.ids, doubts(scores, named), least=1
            )
            labels = np.where(sure, named, labels)
        soft = np.eye(classes)[labels] * np.where(sure, 1.0, self.unsure)[:, None]
        selected = teacher.relabelled(labels).confidence > theta
        return Selection(
            selected=selected,
            theta=theta,
            mu=np.full(classes, min(self.growth * round_, 1.0)),
            confident=np.bincount(teacher.predicted[teacher.confidence > theta], minlength=classes),
            kept=np.bincount(labels[selected], minlength=classes),
            labels=labels,
            soft=soft,
        )

    def _scores(self, teacher: TeacherPredictions, round_: int) -> Float[np.ndarray, "n k"]:
        assert teacher.probabilities is not None
        assert teacher.features is not None
        order = np.argsort(np.asarray(teacher.ids), kind="stable")  # whatever that of the rows
        features = torch.from_numpy(teacher.features[order]).double()
        edges = neighbours_of(features, self.correlation, self.neighbours)
        given = torch.from_numpy(teacher.probabilities[order]).float()
        seed = derive(self.seed, "graph", round_)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            refined = _refined(principal(features, WIDTH).float(), given, edges, self.steps)
        scores = np.empty_like(teacher.probabilities)
        scores[order] = refined.numpy()
        return scores


def neighbours_of(features: Float[Tensor, "n d"], least: float, most: int) -> Float[Tensor, "n n"]:
    r"""D^{-1/2} (A + I) D^{-1/2}, sparse, of the undirected graph of `GraphRefined`.

    Correlation as of two rows of numbers: over the features, about each cloud's own mean.
    """
    n = len(features)
    centred = features - features.mean(dim=1, keepdim=True)
    unit = centred / centred.norm(dim=1, keepdim=True).clamp_min(1e-12)
    pairs = [torch.arange(n).expand(2, n)]
    for begin in range(0, n, _BLOCK):
        rows = torch.arange(begin, min(begin + _BLOCK, n))
        close = unit[rows] @ unit.T
        close[torch.arange(len(rows)), rows] = -2.0
        value, column = close.topk(min(most, n - 1), dim=1)
        row = rows[:, None].expand_as(column)[value > least]
        column = column[value > least]
        pairs += [torch.stack([row, column]), torch.stack([column, row])]
    index: Int[Tensor, "2 e"] = torch.cat(pairs, dim=1).unique(dim=1)
    degree = torch.bincount(index[0], minlength=n).float()
    value = (degree[index[0]] * degree[index[1]]).rsqrt()
    return torch.sparse_coo_tensor(index, value, (n, n), check_invariants=True, is_coalesced=True)


def principal(features: Float[Tensor, "n d"], most: int) -> Float[Tensor, "n m"]:
    """The first min(most, D) principal components, at a mean square of 1."""
    centred = features - features.mean(dim=0)
    _, vectors = torch.linalg.eigh(centred.T @ centred)  # ascending
    found = centred @ vectors.flip(1)[:, :most]
    return found / found.square().mean().sqrt().clamp_min(1e-12)


class GraphNet(nn.Module):
    """Three graph convolutions (Kipf and Welling, ICLR 2017, eq. 2), ReLU and dropout 0.5 between.

    Args:
        width: of features and hidden layers.
        classes: K; a linear map of the probabilities is added to the features.
    """

    def __init__(self, width: int, classes: int) -> None:
        super().__init__()
        self.of_scores = nn.Linear(classes, width)
        self.layers = nn.ModuleList(nn.Linear(width, d) for d in (width, width, classes))

    def forward(
        self, x: Float[Tensor, "n d"], scores: Float[Tensor, "n k"], edges: Tensor
    ) -> Float[Tensor, "n k"]:
        """Logits."""
        x = x + self.of_scores(scores)
        for i, layer in enumerate(self.layers):
            if i:
                x = F.dropout(x.relu(), training=self.training)
            x = torch.sparse.mm(edges, layer(x))
        return x


def _refined(
    features: Float[Tensor, "n d"], given: Float[Tensor, "n k"], edges: Tensor, steps: int
) -> Float[Tensor, "n k"]:
    """Predictions of a graph net that has learned the teacher's."""
    net = GraphNet(features.shape[1], given.shape[1])
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-3, weight_decay=5e-4)
    labels = given.argmax(dim=1)
    with torch.enable_grad():
        for _ in range(steps):
            shown = given * (torch.rand(len(given), 1) >= 0.2)
            loss = F.cross_entropy(net(features, shown, edges), labels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    with torch.no_grad():
        return net.eval()(features, given, edges).softmax(dim=1)
