import torch

from qs3.models.frontview import front_pictures, sizes


def test_a_picture_by_hand() -> None:
    # As wide as high, 1 m; the camera looks along +y. Behind the lower left point lies another.
    # Their mean is at 2.6 m.
    points = torch.tensor([[[-0.5, 2, 0], [-0.5, 3, 0], [0.5, 2, 0.0], [0.5, 4, 1], [-0.5, 2, 1]]])
    picture = front_pictures(points.double(), 8)[0]
    side = 1.05
    there = torch.zeros(8, 8)
    there[[0, 0, 7, 7], [0, 7, 0, 7]] = 1
    assert torch.equal(picture[3].float(), there)
    assert picture[4].sum() == 16  # with their neighbours
    behind = torch.zeros(8, 8)
    behind[[0, 7, 7], [0, 0, 7]], behind[0, 7] = -0.6, 1.4  # the point at 3 m is hidden
    torch.testing.assert_close(picture[1].float(), behind)
    torch.testing.assert_close(picture[0].float(), 2 * behind / side)
    heights = torch.zeros(8, 8)
    heights[0, [0, 7]], heights[7, [0, 7]] = 1 - 0.7, -0.7
    torch.testing.assert_close(picture[2].float(), heights)


def test_sizes_by_hand() -> None:
    points = torch.tensor([[[-1.0, 0, 0.5], [1.0, 0, 1.5]]])
    log_least, spread = torch.tensor(0.01).log(), 1.0
    expected = [torch.tensor(2.0).log(), log_least, 0.0, 0.5, 1.5, 1.0, spread, 0.0]
    torch.testing.assert_close(sizes(points), torch.tensor([expected]))
