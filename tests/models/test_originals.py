"""Numbers of the authors' own nets, with weights and clouds by formula (`tests.models.by_formula`).

Made once with their code on the CPU in float64, dropout 0; see docs/reference/backbones.md (of
PointNet++ yanx27/Pointnet_Pointnet2_pytorch). Each row: the ten logits of the first cloud and the
norm of the gradient in all points.
"""

from __future__ import annotations

import pytest
import torch
from torch import nn

from qs3.models.base import PointClassifier
from qs3.models.dgcnn import dgcnn
from qs3.models.pointnet import pointnet
from qs3.models.pointnet2 import pointnet2
from tests.models.by_formula import clouds, figures, fill

PUBLISHED = {  # (net, variant, train mode)
    ("dgcnn", "simpleview", True): (
        *(0.0940602, 0.159626, -0.200738, -0.0781116, 0.22282),
        *(-0.0256537, -0.136297, 0.0343683, 0.0439518, 0.0581685, 109.981),
    ),
    ("dgcnn", "simpleview", False): (
        *(-0.164143, 0.207631, 0.0562193, -0.132785, -0.032718),
        *(0.0356515, 0.11765, -0.0335273, -0.208233, 0.132609, 0.00121084),
    ),
    ("dgcnn", "uda", True): (
        *(0.0968984, 0.103949, -0.202131, -0.0223994, 0.222768),
        *(-0.0813646, -0.134799, 0.0900403, 0.0410088, 0.00257286, 267.518),
    ),
    ("dgcnn", "uda", False): (
        *(-0.0841975, -0.0505462, -0.0170257, 0.127292, 0.0337776),
        *(-0.226152, 0.0579485, 0.229825, -0.155366, -0.132116, 0.00288229),
    ),
    ("dgcnn", "defrec", True): (
        *(0.0117161, -0.155891, 0.082942, 0.150224, -0.173654),
        *(-0.0483634, 0.15649, -0.033142, -0.0534997, 0.00157872, 1161.87),
    ),
    ("dgcnn", "defrec", False): (
        *(0.256021, -0.114621, -0.162433, 0.115322, 0.0726271),
        *(-0.0198534, -0.0905307, -0.0552414, 0.194095, 0.0172526, 0.0064925),
    ),
    ("pointnet", "simpleview", True): (
        *(-2.48084, -2.42013, -2.07343, -2.14618, -2.64513),
        *(-2.38978, -1.9267, -2.33211, -2.60621, -2.24854, 17973.4),
    ),
    ("pointnet", "simpleview", False): (
        *(-2.21981, -2.21188, -2.4207, -2.42625, -2.37142),
        *(-2.19765, -2.28622, -2.59574, -2.32068, -2.07315, 0.000670668),
    ),
    ("pointnet", "uda", True): (
        *(-0.00778497, -0.07472, -0.0171836, 0.003882, 0.121043),
        *(-0.0481133, -0.17934, 0.158222, 0.120791, -0.207961, 656007),
    ),
    ("pointnet", "uda", False): (
        *(-0.186716, -0.204405, 0.165113, 0.128836, -0.064496),
        *(-0.168252, 0.00931721, 0.273464, -0.0708573, -0.31823, 0.00083987),
    ),
    ("pointnet", "basic", True): (
        *(0.142409, -0.0790694, -0.0172557, 0.0592361, -0.00951369),
        *(-0.0849632, 0.136089, -0.0955785, -0.000657055, 0.0655118, 9.84625),
    ),
    ("pointnet", "basic", False): (
        *(0.0897412, -0.0287424, -0.0652085, 0.104782, -0.0526227),
        *(-0.0443204, 0.0979402, -0.0599487, -0.0337435, 0.0960326, 0.0011109),
    ),
    ("pointnet2", "ssg", True): (
        *(0.0298412, 0.151493, -0.135183, -0.117643, 0.20685),
        *(0.00776706, -0.162699, 0.0530215, 0.0558266, 0.00299757, 17401.6),
    ),
    ("pointnet2", "ssg", False): (
        *(-0.0294398, 0.0591844, -0.0735068, -0.0269349, 0.142819),
        *(-0.0812794, -0.0963575, 0.140346, -0.0127811, -0.0825467, 0.00162204),
    ),
    ("pointnet2", "msg", True): (
        *(0.157728, -0.380308, -0.120848, 0.283043, 0.19502),
        *(-0.275816, -0.282661, 0.373335, 0.27029, -0.467633, 204814),
    ),
    ("pointnet2", "msg", False): (
        *(-0.0667892, 0.0209309, 0.0932563, -0.123753, -0.00852767),
        *(0.136262, -0.0898078, -0.043748, 0.0882605, -0.0458262, 0.000371285),
    ),
}


def _modules(net: PointClassifier, name: str) -> list[nn.Module]:
    """In the order in which data passes them."""
    b = net.backbone
    if name == "pointnet2":
        return [net]
    if name == "dgcnn":
        parts = [b.transform, b.edge_convs, b.conv5, b.norm5]
    else:
        parts = [b.input_transform, b.first, b.feature_transform, b.middle, b.last]
    return [part for part in (*parts, net.head) if part is not None]


LARGEST = ("pointnet2", "msg", True)
EACH = [pytest.param(*k, marks=pytest.mark.slow if k == LARGEST else ()) for k in PUBLISHED]


@pytest.mark.parametrize(("name", "variant", "training"), EACH)
def test_logits_and_gradients_are_the_authors(name: str, variant: str, training: bool) -> None:
    build = {"dgcnn": dgcnn, "pointnet": pointnet, "pointnet2": pointnet2}[name]
    net = build(10, variant=variant, dropout=0.0).double().train(training)
    fill(_modules(net, name))
    if variant == "msg":  # there the features come first
        for mlp in net.backbone.levels[1].mlps:
            weight = mlp.linears[0].weight.data
            weight.copy_(torch.cat([weight[:, -3:], weight[:, :-3]], dim=1))
    points = clouds(4, 700 if name == "pointnet2" else 96)
    if name == "pointnet2":
        points = points / points.norm(dim=2).amax(1)[:, None, None]
    logits = net(points.requires_grad_())
    if (name, variant) == ("pointnet", "simpleview"):
        logits = logits.log_softmax(1)  # there a part of the net
    *expected, gradient = PUBLISHED[name, variant, training]
    *found, found_gradient = figures(logits, points)
    assert found == pytest.approx(expected, abs=1e-5)
    assert found_gradient == pytest.approx(gradient, rel=1e-5)
