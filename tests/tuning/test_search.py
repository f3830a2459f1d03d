"""A search finds the numbers that made the target, goes on where it stopped, and reads no label."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.errors import ConfigError, DataError
from qs3.tuning import parameters
from qs3.tuning.features import Distance, roughness
from qs3.tuning.scenes import in_unit_ball
from qs3.tuning.search import by_differences, by_twin, search, settled
from qs3.tuning.state import State, read_state

KEYS = ("infrared.read_noise_e", "infrared.psf_px")


class Bent:
    """A bent sheet whose noise is read_noise_e / 2000, along a wave that psf_px makes higher."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self.flat = torch.from_numpy(rng.uniform(-1, 1, (300, 2)))
        self.noise = torch.from_numpy(rng.standard_normal(300))

    def cloud(self, values, points, seed):
        x, y = self.flat.T
        high = 0.3 * values["infrared.psf_px"] * torch.sin(3 * x)
        z = high + values["infrared.read_noise_e"] / 2000 * self.noise
        return in_unit_ball(torch.stack([x, y, z], dim=1))

    def measured(self, values, points):
        return self.cloud({k: torch.tensor(v) for k, v in values.items()}, points, 0)


class Blind(Bent):
    def measured(self, values, points):
        raise DataError("nothing is seen")


TRUTH = {"infrared.read_noise_e": 90.0, "infrared.psf_px": 1.6}
START = {"infrared.read_noise_e": 12.0, "infrared.psf_px": 0.5}


@pytest.fixture(scope="module")
def distance():
    return Distance(roughness, [Bent(100 + i).measured(TRUTH, 300) for i in range(16)])


def begun():
    zeros = [0.0] * len(KEYS)
    return State("s", parameters.free(START).tolist(), zeros, list(zeros))


def run(state, distance, steps=40, **more):
    more = {"batch": 6, "points": 300, "rate": 0.3, "seed": 0, **more}
    return search(state, KEYS, [Bent(i) for i in range(8)], distance, steps=steps, **more)


def values_of(state):
    return parameters.as_floats(parameters.bounded(torch.tensor(settled(state)), KEYS))


@pytest.mark.parametrize("slopes", ["differences", "twin"])
def test_numbers_go_to_those_that_made_the_target(slopes, distance):
    state = run(begun(), distance, slopes=slopes)
    found = values_of(state)
    assert state.distances[-1] < 0.2 * state.distances[0]
    for key, true in TRUTH.items():
        assert found[key] == pytest.approx(true, rel=0.25), key


def test_both_slopes_agree_where_the_twin_is_the_sensor():
    """By smooth descriptors: roughness jumps where a point gets another neighbour."""
    target = [Bent(100 + i).measured(TRUTH, 300) for i in range(16)]
    distance = Distance(lambda clouds: torch.cat([clouds.std(1), clouds.abs().mean(1)], 1), target)
    at, objects = parameters.free(START), [Bent(i) for i in range(6)]
    first, differences = by_differences(at, KEYS, objects, distance, 300, 1e-3)
    second, twin = by_twin(at, KEYS, objects, distance, 300, 0)
    assert first == pytest.approx(second)
    np.testing.assert_allclose(differences, twin, rtol=0.01)


def test_an_interrupted_search_ends_the_same(distance, tmp_path):
    whole, path = run(begun(), distance, steps=6), tmp_path / "a.json"
    begin = begun()

    class StopError(Exception):
        pass

    def stop(state):
        state.write(path)
        if state.steps == 3:
            raise StopError

    with pytest.raises(StopError):
        run(begin, distance, steps=6, after=stop)
    again = read_state(path, "s")
    assert again.steps == 3
    assert run(again, distance, steps=6) == whole


def test_objects_that_nothing_sees_are_left_out(distance):
    at, objects = parameters.free(START), [Bent(0), Bent(1), Bent(2)]
    alone = by_differences(at, KEYS, objects, distance, 300)
    joined = by_differences(at, KEYS, [*objects, Blind(3)], distance, 300)
    assert alone[0] == joined[0]
    for slope in (by_differences, by_twin):
        with pytest.raises(DataError, match="next to nothing"):
            slope(at, KEYS, [Bent(0), Blind(1)], distance, 300, 1)


def test_distance_of_the_target_is_its_floor(distance):
    clouds = [Bent(100 + i).measured(TRUTH, 300) for i in range(16)]
    assert float(distance(clouds)) == pytest.approx(0, abs=1e-9)
    other = [Bent(200 + i).measured(TRUTH, 300) for i in range(8)]
    far = [Bent(200 + i).measured(START, 300) for i in range(8)]
    assert float(distance(other)) < 3 * distance.floor(8)
    assert float(distance(far)) > 4 * float(distance(other))


def test_the_floor_is_the_mean_distance_of_other_clouds_of_the_target():
    generator = torch.Generator().manual_seed(0)
    clouds = torch.randn(600, 5, generator=generator, dtype=torch.float64)
    floors, expected = [], []
    for _ in range(20):
        clouds = clouds[torch.randperm(600, generator=generator)]
        distance = Distance(lambda each: each, list(clouds[:100]))
        floors.append(distance.floor(50))
        for _ in range(40):
            others = 100 + torch.randperm(500, generator=generator)[:50]
            expected.append(float(distance.of(clouds[others])))
    assert np.mean(floors) == pytest.approx(np.mean(expected), rel=0.08)
    assert np.std(floors) < 0.05 * np.mean(floors)


def test_roughness_of_a_noisy_plane_is_its_noise():
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (4000, 3)) * [1, 1, 0]
    noisy = [flat + [0, 0, 1] * rng.normal(0, sd, (4000, 1)) for sd in (0.002, 0.004)]
    found = roughness(torch.from_numpy(np.stack(noisy)))
    # Of 13 points, three of whose freedoms a plane takes.
    assert float(found[0, 2]) == pytest.approx(np.log(0.002 * np.sqrt(10 / 13)), abs=0.1)
    assert float(found[1, 2] - found[0, 2]) == pytest.approx(np.log(2), abs=0.06)
    assert (found[1, 5:] - found[0, 5:]).abs().max() < 0.05  # along the plane nothing changes


# --- numbers


def test_free_numbers_and_values_are_inverse():
    values = {key: low * (high / low) ** 0.3 for key, (low, high) in parameters.BOUNDS.items()}
    keys = tuple(values)
    again = parameters.bounded(torch.tensor(parameters.free(values)), keys)
    assert parameters.as_floats(again) == pytest.approx(values)
    ends = parameters.bounded(torch.full((len(keys),), 60.0, dtype=torch.float64), keys)
    for key, value in parameters.as_floats(ends).items():
        assert value == pytest.approx(parameters.BOUNDS[key][1])


def test_a_value_out_of_its_range_begins_at_its_end():
    assert np.isfinite(parameters.free({"infrared.psf_px": 0.0})).all()
    found = parameters.bounded(torch.tensor(parameters.free({"infrared.psf_px": 0.0})), KEYS[1:])
    assert float(found["infrared.psf_px"]) == pytest.approx(0.2, rel=0.01)


def test_unknown_parameters_are_named():
    with pytest.raises(ConfigError, match="baseline_m cannot be tuned"):
        parameters.check_keys(["ambient", "baseline_m"])
    with pytest.raises(ConfigError, match="none cannot"):
        parameters.check_keys([])


# --- the file


def saved(tmp_path, **changes):
    path = tmp_path / "a.json"
    state = replace(begun(), distances=[0.5], path=[[0.0, 0.0]])
    state.write(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return path


def test_a_search_of_other_settings_is_not_gone_on_with(tmp_path):
    path = saved(tmp_path)
    assert read_state(path, "s").steps == 1
    with pytest.raises(ConfigError, match="other settings"):
        read_state(path, "t")
    assert read_state(tmp_path / "none.json", "s") is None


@pytest.mark.parametrize(
    "changes",
    [
        {"numbers": [1.0]}, {"square": [-1.0, 0.0]}, {"mean": "ab"}, {"distances": []},
        {"path": [["a", 0.0]]}, {"path": 3}, {"numbers": [float("nan"), 0.0]}, {"more": 1},
        {"settings": 5},
    ],
)  # fmt: skip
def test_damaged_searches_are_refused(changes, tmp_path):
    with pytest.raises(DataError, match=r"a\.json is no search"):
        read_state(saved(tmp_path, **changes), "s")
