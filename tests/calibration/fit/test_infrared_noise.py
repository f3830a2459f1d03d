"""Noise over time against frames of the camera itself, and what speckle hides of it."""

import numpy as np
import pytest
import torch
import torch.autograd.forward_ad as forward_ad

from qs3.calibration.fit.infrared_noise import Speckled, noise_residuals, over_time, through
from qs3.sensors.gradients.twin import gaussian
from qs3.sensors.optics.infrared import InfraredCamera

GAIN = 100.0
ELECTRONS, READ = 5000.0, 20.0


def number(value):
    return torch.tensor(float(value), dtype=torch.float64)


def frames(radiance, ambient, contrast, width, count, everywhere=False):
    """Of one still scene, by the ordinary camera."""
    camera = InfraredCamera(
        electrons_at_white=ELECTRONS, read_noise_e=READ, speckle_contrast=contrast, psf_px=width,
        ambient_speckles=everywhere,
    )  # fmt: skip
    even = np.full_like(radiance, ambient)
    return [
        torch.from_numpy(
            camera.expose(
                even + radiance, GAIN, np.random.default_rng(i), None if everywhere else even
            ).astype(float)
        )
        for i in range(count)
    ]


def dotted(seed, shape=(300, 300)):
    """A tenth of the pixels is lit."""
    lit = np.random.default_rng(seed).random(shape) < 0.1
    return (2.5 * lit).astype(np.float32)


def speckled(radiance, contrast, everywhere=False):
    drawn = np.random.default_rng(9).gamma(1 / contrast**2, contrast**2, radiance.shape)
    light, grain = (torch.from_numpy(x) for x in (radiance.astype(float), (drawn - 1) / contrast))
    return Speckled(light, grain, everywhere)


def white(level):
    """Variance by photons, read-out and rounding at a grey value."""
    per_grey = ELECTRONS / 255
    return level / per_grey + (READ / per_grey) ** 2 + 1 / 12


def test_on_even_light_neighbours_share_what_the_lens_spreads():
    """By hand: a grain of the lens's kernel k is seen d px away with sum k(n) k(n + d)."""
    even = np.full((300, 300), 1.0, dtype=np.float32)
    found = over_time(frames(even, 0.0, 0.2, 0.8, 8))
    kernel = np.exp(-(np.arange(-4, 5) ** 2) / (2 * 0.8**2))
    kernel /= kernel.sum()
    shared = [kernel[lag:] @ kernel[: len(kernel) - lag] for lag in range(3)]
    speckle = (0.2 * GAIN) ** 2 * shared[0] * np.array(shared)
    moments = found.moments.mean(dim=0).numpy()
    np.testing.assert_allclose(moments - [white(GAIN), 0, 0], speckle, rtol=0.02)
    assert found.sorters == 4
    assert found.known.all()


@pytest.mark.parametrize("everywhere", [False, True])
def test_speckle_on_dots_is_that_of_the_camera_s_frames(everywhere):
    light, contrast, width = dotted(0), 0.25, 0.9
    found = over_time(frames(light, 0.1, contrast, width, 12, everywhere))
    model = speckled(light, contrast, everywhere)
    expected = model.noise(model.behind(number(width)), found, number(0.1), number(contrast))
    seen = found.moments.clone()
    seen[:, 0] -= white(found.level)
    for lag in range(3):
        # Of the same dots, in bins with more speckle than the noise of the estimate.
        np.testing.assert_allclose(seen[2:, lag], expected[2:, lag], rtol=0.06)
    residuals = noise_residuals(found, expected, number(ELECTRONS / 255), number(READ))
    assert float(residuals.square().mean().sqrt()) < 1.6


def cost(found, model, contrast, width, electrons, read):
    """Of the best contrast near the one given."""
    sums = []
    for share in (0.9, 0.95, 1.0, 1.05, 1.1):
        fields = model.behind(number(width))
        speckle = model.noise(fields, found, number(0.1), number(share * contrast))
        rest = noise_residuals(found, speckle, number(electrons / 255), number(read))
        sums.append(float(rest.square().sum()))
    return min(sums)


def test_neighbours_tell_noise_from_strong_speckle_and_a_sharp_lens_hides_it():
    """The model knows other dots. Read-out noise of twice and half the true one does not fit
    where the lens spreads grains; without a lens, all light speckled, nobody knows it."""
    for width, told in ((0.9, True), (0.0, False)):
        found = over_time(frames(dotted(0), 0.1, 0.3, width, 8, everywhere=True))
        model = speckled(dotted(1), 0.3, everywhere=True)
        true, double, half = (
            cost(found, model, 0.3, width, ELECTRONS, READ * share) for share in (1, 2, 0.5)
        )
        assert (min(double, half) > true + 30) == told, (width, true, double, half)


def test_bright_grains_are_not_taken_for_noise_of_bright_pixels():
    """On even light all bins have one variance, however skewed the noise is."""
    even = np.full((300, 300), 0.5, dtype=np.float32)
    parted = over_time(frames(even, 0.0, 0.6, 0.5, 4)).moments[:, 0]
    together = over_time(frames(even, 0.0, 0.6, 0.5, 3)).moments[:, 0]
    assert parted.max() / parted.min() < 1.1
    assert together.max() / together.min() > 2


def test_black_and_white_bins_are_left_out_and_one_frame_tells_nothing():
    light = np.zeros((200, 200), dtype=np.float32)
    light[100:] = 5.0
    found = over_time(frames(light, 0.0, 0.0, 0.0, 4))
    assert not found.known.any()
    assert over_time([torch.zeros(100, 100)]) is None


def test_through_is_a_convolution_down_and_along():
    rng = np.random.default_rng(0)
    image, down, along = rng.random((12, 15)), rng.random(5), rng.random(3)
    slow = np.zeros_like(image)
    for r, c in np.ndindex(image.shape):
        for i, j in np.ndindex(5, 3):
            y, x = r + i - 2, c + j - 1
            if 0 <= y < 12 and 0 <= x < 15:
                slow[r, c] += down[i] * along[j] * image[y, x]
    found = through(*(torch.from_numpy(x) for x in (image, down, along)))
    np.testing.assert_allclose(found, slow, atol=1e-12)


@pytest.mark.parametrize("which", [(0,), (1,), (0, 1)])
def test_the_tangent_of_through_is_a_finite_difference(which):
    generator = torch.Generator().manual_seed(0)
    image, *kernels = (
        torch.rand(shape, generator=generator, dtype=torch.float64) for shape in ((12, 15), 5, 3)
    )
    moved = [torch.rand_like(kernel) if i in which else None for i, kernel in enumerate(kernels)]
    step = 1e-4

    def at(scale):
        return through(
            image,
            *(k if m is None else k + scale * m for k, m in zip(kernels, moved, strict=True)),
        )

    with forward_ad.dual_level():
        dual = [
            k if m is None else forward_ad.make_dual(k, m)
            for k, m in zip(kernels, moved, strict=True)
        ]
        value, tangent = forward_ad.unpack_dual(through(image, *dual))
    torch.testing.assert_close(value, at(0.0))
    torch.testing.assert_close(tangent, (at(step) - at(-step)) / (2 * step))


def test_the_lens_of_width_zero_is_none():
    assert gaussian(number(0.05)).numpy() == pytest.approx([0, 1, 0])
