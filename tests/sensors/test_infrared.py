import numpy as np
import pytest

from qs3.errors import ConfigError
from qs3.sensors.infrared import InfraredCamera


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


def test_an_empty_region_gives_a_dark_image_not_an_error():
    camera = InfraredCamera()
    radiance = np.ones((4, 4), np.float32)
    assert camera.gain(radiance, np.zeros((4, 4), bool)) == 0.0


@pytest.mark.parametrize("wrong", [{"white_level": 300.0}, {"white_quantile": 0.0}])
def test_settings_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        InfraredCamera(**wrong)
