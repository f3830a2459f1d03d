"""Each way of choosing at work: on a problem where its idea should help, it beats its own copy.

A cloud is one point of the plane, three classes are Gaussian, a student is a small net. The
teacher, all draws and the student's first weights are the same; the copy lacks the idea alone.
The problems were made for the ideas: they say that the code does what its paper wants, not that
this helps on scans.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from qs3.selftraining.baselines import Random
from qs3.selftraining.cbst import Cbst
from qs3.selftraining.selectors import Qbst, Selector, Spst, TeacherPredictions
from qs3.selftraining.student_loss import Student

CLASSES = 3
SEEDS = 4
CENTRES = torch.tensor([[0.0, 1.0], [0.87, -0.5], [-0.87, -0.5]])


class Problem:
    """A labelled source, an unlabelled target, held-out target samples and a trained teacher.

    Args:
        seed: of all draws.
        spread: standard deviation of a class, in units of the centres' distance from 0.
        turn: of the target about 0, in radians.
        move: [3, 2] by how much each class's centre is moved in the target.
        portions: of the classes in the target, of the samples held out too.
    """

    def __init__(
        self,
        seed: int,
        spread: float = 0.3,
        turn: float = 0.0,
        move: Tensor | None = None,
        portions: Sequence[float] = (1 / 3, 1 / 3, 1 / 3),
    ) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        c, s = math.cos(turn), math.sin(turn)
        rotation = torch.tensor([[c, s], [-s, c]])
        centres = CENTRES @ rotation + (torch.zeros(3, 2) if move is None else move)
        counts = (600 * torch.tensor(portions)).round().long()
        self.labels = torch.arange(CLASSES).repeat_interleave(counts)
        y_source = torch.arange(300) % CLASSES
        source = self._draw(CENTRES, y_source, spread)
        self.target, self.held_out = (self._draw(centres, self.labels, spread) for _ in "ab")
        self.seed = seed
        self.teacher = self.trained(Student(), source, y_source)

    def _draw(self, centres: Tensor, labels: Tensor, spread: float) -> Tensor:
        noise = torch.randn(len(labels), 2, generator=self.generator)
        return nn.functional.pad(centres[labels] + spread * noise, (0, 1))[:, None]  # [n, 1, 3]

    def trained(self, method: Student, points: Tensor, labels: Tensor) -> nn.Module:
        """A net after 150 steps of Adam on all samples at once; first weights are always equal."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            net = nn.Sequential(nn.Flatten(), nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, CLASSES))
        optimizer = torch.optim.Adam(net.parameters(), 1e-2)
        batch = {"target": {"points": points, "y_pseudo": labels}}
        for _ in range(150):
            loss = method.loss(net, batch, self.generator)["pseudo"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return net

    def student(
        self, selector: Selector, theta: float, method: Student | None = None, rounds: int = 3
    ) -> nn.Module:
        """Student of the last round: each begins afresh, on the selected target samples alone."""
        teacher = self.teacher
        ids = [f"{i:04d}" for i in range(len(self.target))]
        for round_ in range(rounds):
            p = probabilities(teacher, self.target)
            selection = selector.select(TeacherPredictions.of(p, ids), theta, round_)
            labels = p.argmax(1) if selection.labels is None else selection.labels
            y = torch.from_numpy(labels)
            if selection.soft is not None:
                y = torch.from_numpy(selection.soft).float()
            keep = torch.from_numpy(selection.selected)
            teacher = self.trained(method or Student(), self.target[keep], y[keep])
        return teacher

    def balanced_accuracy(self, net: nn.Module) -> float:
        """Balanced accuracy on the held-out target samples."""
        right = torch.from_numpy(probabilities(net, self.held_out).argmax(1)) == self.labels
        return float(np.mean([right[self.labels == k].double().mean() for k in range(CLASSES)]))

    def log_loss(self, net: nn.Module) -> float:
        """-log of the true class's probability, mean over the held-out target samples."""
        p = probabilities(net, self.held_out)
        return float(-np.log(np.take_along_axis(p, self.labels.numpy()[:, None], 1)).mean())


@torch.no_grad()
def probabilities(net: nn.Module, points: Tensor) -> np.ndarray:
    """[n, K], float64."""
    return net(points).double().softmax(1).numpy()


def gain(make: Callable[[int], Problem], *ideas: tuple[Selector, float]) -> float:
    """In balanced accuracy, of the first (selector, theta) over the second; mean over the seeds.

    Without a second one over the teacher.
    """
    gains = []
    for seed in range(SEEDS):
        problem = make(seed)
        nets = [problem.student(*idea) for idea in ideas] + [problem.teacher]
        gains.append(problem.balanced_accuracy(nets[0]) - problem.balanced_accuracy(nets[1]))
    return float(np.mean(gains))


def turned(seed: int) -> Problem:
    """The target turned by 0.8 about 0: the teacher gives each class part of the next one."""
    return Problem(seed, turn=0.8)


def imbalanced(seed: int) -> Problem:
    """The target differs from the source in the portions of its classes alone."""
    return Problem(seed, spread=0.4, portions=(0.8, 0.1, 0.1))


def nearer(seed: int) -> Problem:
    """Class 0 is moved most of the way to the others: the teacher is seldom sure of it."""
    move = torch.zeros(CLASSES, 2)
    move[0, 1] = -0.9
    return Problem(seed, move=move)


def overlapping(seed: int) -> Problem:
    """Classes that overlap, and a turn: many pseudo-labels are wrong, whatever their confidence."""
    return Problem(seed, spread=0.6, turn=0.5)


def test_students_surpass_the_teacher_that_labelled_for_them() -> None:
    """Six seeds gave 0.059 +- 0.009 for SPST, 0.166 +- 0.020 for QBST."""
    assert gain(turned, (Spst(), 0.8)) > 0.02
    assert gain(turned, (Qbst(), 0.8)) > 0.08


def test_qbst_s_balance_helps_where_the_teacher_names_some_classes_too_often() -> None:
    """Six seeds gave 0.107 +- 0.015 over mu = 1."""
    assert gain(turned, (Qbst(), 0.8), (Qbst(mu="one"), 0.8)) > 0.05


def test_qbst_s_balance_costs_where_a_good_teacher_labels_an_imbalanced_target() -> None:
    """Six seeds gave -0.061 +- 0.008 against mu = 1.

    Of the large class only the most confident are kept, those far from the others, so the border
    moves into it.
    """
    assert gain(imbalanced, (Qbst(), 0.6), (Qbst(mu="one"), 0.6)) < -0.02


def test_confidence_chooses_better_than_chance() -> None:
    """As many samples of each class, drawn from all: six seeds gave QBST 0.139 +- 0.021 more."""
    assert gain(turned, (Qbst(), 0.8), (Random(Qbst(), pool="all"), 0.8)) > 0.06


def test_cbst_does_not_forget_the_class_of_which_the_teacher_is_unsure() -> None:
    """Its own threshold for each class: six seeds gave 0.106 +- 0.009 over one for all."""
    assert gain(nearer, (Cbst(), 0.0), (Spst(), 0.9)) > 0.05


def test_crst_s_regularisers_keep_wrong_pseudo_labels_from_being_believed() -> None:
    """Log loss of the truth: six seeds gave 0.50 +- 0.05 (MRKLD), 0.44 +- 0.05 (LRENT) less.

    LRENT with alpha = 1; with the 0.25 of its code there was no gain here (-0.014 +- 0.005).
    """
    hard, soft = Cbst(portion=0.8, most=1.0), Cbst(portion=0.8, most=1.0, labels="lrent", alpha=1)
    less = []
    for seed in range(SEEDS):
        p = overlapping(seed)
        nets = p.student(hard, 0.0), p.student(hard, 0.0, Student(mrkld=0.1)), p.student(soft, 0.0)
        copy, mrkld, lrent = (p.log_loss(net) for net in nets)
        less.append((copy - mrkld, copy - lrent))
    assert min(np.mean(less, axis=0)) > 0.2
