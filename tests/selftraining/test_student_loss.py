import pytest
import torch
from torch.nn import functional as F

from qs3.selftraining.student import Student
from tests.methods.shapes import tiny_net


def _batch(epoch: int = 0, soft: bool = False) -> dict:
    generator = torch.Generator().manual_seed(0)
    clouds = torch.rand(4, 32, 3, generator=generator) * 2 - 1
    hard = torch.tensor([0, 1, 2, 3])
    pseudo = F.one_hot(hard, 4).float() if soft else hard
    return {
        "source": {"points": clouds, "y_source": hard},
        "target": {"points": clouds.flip(0), "y_pseudo": pseudo},
        "epoch": epoch,
    }


def _terms(student: Student, batch: dict) -> dict[str, float]:
    terms = student.loss(tiny_net(), batch, torch.Generator().manual_seed(0))
    return {name: term.item() for name, term in terms.items()}


def test_weights_fall_from_the_first_epoch_of_the_rounds() -> None:
    full = _terms(Student(), _batch())
    for epoch, w in ((20, 1.0), (21, 0.995), (119, 0.505)):
        student = Student(weight_step=0.005, first_epoch=20)
        later = _terms(student, _batch(epoch))
        assert later["pseudo"] / full["pseudo"] == pytest.approx(w)
        assert later["source"] / full["source"] == pytest.approx(w)


@pytest.mark.parametrize("pcm", [False, True])
def test_soft_labels_that_are_sure_are_hard_labels(pcm: bool) -> None:
    hard, soft = (_terms(Student(pcm=pcm), _batch(soft=x)) for x in (False, True))
    assert hard == pytest.approx(soft)


def test_mrkld_is_of_the_target_alone() -> None:
    plain, regularised = _terms(Student(), _batch()), _terms(Student(mrkld=0.1), _batch())
    assert plain["source"] == regularised["source"]
    net = tiny_net()
    p = net(_batch()["target"]["points"]).softmax(dim=1)
    extra = -0.1 * p.log().mean().item()
    assert regularised["pseudo"] - plain["pseudo"] == pytest.approx(extra, rel=1e-4)
