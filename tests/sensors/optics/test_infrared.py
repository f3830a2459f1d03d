import numpy as np
import pytest

from qs3.sensors.optics.infrared import InfraredCamera


def test_the_exposure_puts_the_quantile_at_the_level():
    camera = InfraredCamera(white_quantile=1.0, white_level=200.0, read_noise_e=0.0)
    radiance = np.linspace(0, 3, 1000, dtype=np.float32).reshape(10, 100)
    gain = camera.gain(radiance, np.ones_like(radiance, dtype=bool))
    assert gain * 3 == pytest.approx(200.0)


def test_noise_has_the_variance_of_shot_and_read_noise():
    camera = InfraredCamera(electrons_at_white=2000.0, read_noise_e=25.0)
    rng = np.random.default_rng(0)
    grey = camera.expose(np.full((400, 400), 128.0, np.float32), 1.0, rng).astype(float)
    per_grey = 2000.0 / 255.0
    electrons = 128 * per_grey
    # 1/12 is the variance of rounding to whole grey values.
    expected = (electrons + 25.0**2) / per_grey**2 + 1 / 12
    assert grey.mean() == pytest.approx(128.0, abs=0.1)
    assert grey.var() == pytest.approx(expected, rel=0.02)


def test_laser_speckle_has_the_contrast_it_says_and_grows_with_the_signal():
    camera = InfraredCamera(
        electrons_at_white=1e9, read_noise_e=0.0, speckle_contrast=0.2, fixed_gain=1.0
    )
    rng = np.random.default_rng(0)
    for level in (40.0, 100.0):
        grey = camera.expose(np.full((500, 500), level, np.float32), 1.0, rng).astype(float)
        assert grey.mean() == pytest.approx(level, rel=0.005)
        assert grey.var() == pytest.approx((0.2 * level) ** 2 + 1 / 12, rel=0.03)


def test_the_lens_spreads_a_point_as_a_gaussian():
    camera = InfraredCamera(electrons_at_white=1e9, read_noise_e=0.0, psf_px=1.5)
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 2000.0
    grey = camera.expose(point, 1.0, np.random.default_rng(0)).astype(float)
    place = np.arange(31) - 15
    assert grey.sum() == pytest.approx(2000.0, rel=0.02)
    assert (grey * place**2).sum() / grey.sum() == pytest.approx(1.5**2, rel=0.06)


def test_what_is_off_draws_nothing():
    """Old datasets keep their bytes: new kinds of noise must not shift the random numbers."""
    radiance = np.random.default_rng(1).random((20, 20)).astype(np.float32)
    a, b = np.random.default_rng(5), np.random.default_rng(5)
    InfraredCamera().expose(radiance, 200.0, a)
    b.standard_normal(radiance.shape, dtype=np.float32)
    assert a.random() == b.random()


def test_ambient_light_without_speckle_keeps_its_evenness():
    """50 of 60 grey values are ambient: the projector's 10 vary by half, which is 5."""
    camera = InfraredCamera(
        electrons_at_white=1e9, read_noise_e=0.0, speckle_contrast=0.5, ambient_speckles=False
    )
    assert camera.needs_ambient
    total, ambient = (np.full((300, 300), value, np.float32) for value in (60.0, 50.0))
    split = camera.expose(total, 1.0, np.random.default_rng(0), ambient)
    assert split.std() == pytest.approx(5.0, rel=0.03)
    assert split.min() >= 50
    assert camera.expose(total, 1.0, np.random.default_rng(0)).std() == pytest.approx(30, rel=0.03)
    none = camera.expose(total, 1.0, np.random.default_rng(0), 0 * ambient)
    np.testing.assert_array_equal(none, camera.expose(total, 1.0, np.random.default_rng(0)))


LIMITED = InfraredCamera(
    white_level=100.0,
    electrons_at_white=2000.0,
    read_noise_e=25.0,
    max_exposure=100.0,
    max_gain=4.0,
)


@pytest.mark.parametrize(
    ("radiance", "gain", "amplified", "grey"),
    [
        (2.0, 50.0, 1.0, 100.0),  # bright: the exposure alone
        (0.5, 200.0, 2.0, 100.0),  # dim: the longest exposure, amplified
        (0.2, 400.0, 4.0, 80.0),  # dark: all there is, and less than white
    ],
)
def test_exposure_comes_first_and_then_an_amplifier_which_amplifies_noise(
    radiance, gain, amplified, grey
):
    flat = np.full((500, 500), radiance, np.float32)
    found = LIMITED.gain(flat, np.ones_like(flat, dtype=bool))
    assert found == pytest.approx(gain)
    assert LIMITED.amplified(found) == pytest.approx(amplified)
    seen = LIMITED.expose(flat, found, np.random.default_rng(0)).astype(float)
    assert seen.mean() == pytest.approx(grey, abs=0.5)
    per_grey = 2000.0 / 255.0 / amplified  # fewer electrons give a grey value
    expected = (grey * per_grey + 25.0**2) / per_grey**2 + 1 / 12
    assert seen.var() == pytest.approx(expected, rel=0.02)
