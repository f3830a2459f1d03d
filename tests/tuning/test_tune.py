"""qs3 tune with the real sensor, its twin and stores."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from qs3.config.compose import composed
from qs3.config.hydra import build
from qs3.errors import ConfigError
from qs3.generation.command import generate
from qs3.generation.objects import mesh_items
from qs3.generation.scan import composed_recipe
from qs3.inference.model_file import read_result, write_result
from qs3.sensors.devices.speckle_stereo import SpeckleStereo
from qs3.tuning import parameters
from qs3.tuning.command import Wanted, _drawn, _settings
from qs3.tuning.features import Distance, roughness
from qs3.tuning.scenes import _points, check_recipe, still_of
from qs3.tuning.search import search, settled
from qs3.tuning.state import State
from tests.commands import main
from tests.composing import compose

TINY = (
    "domain=specklenet10", "views=1", "sensor=speckle_stereo_small", "sensor/matcher=ncc",
    "renderer=mitsuba", "renderer.samples=2", "renderer.threads=1", "sensor.width_px=240",
    "sensor.height_px=240", "sensor.focal_px=333", "sensor.matcher.num_disparities=48",
)  # fmt: skip


def stills(count, *more):
    cfg = composed_recipe([*TINY, "classes=[chair,sofa,bed]", "limit=4", *more])
    recipe, renderer = check_recipe(build(cfg.recipe)), build(cfg.renderer)
    items = [item for item in mesh_items(cfg) if item.split == "train"][::2][:count]
    return [still_of(recipe, item.load(), item.id, cfg.seed, renderer) for item in items]


def test_the_twin_s_cloud_without_noise_is_the_true_surface():
    (one,) = stills(
        1, "classes=[bed]", "sensor.width_px=540", "sensor.height_px=540", "sensor.focal_px=750",
        "sensor.matcher.num_disparities=80",
    )  # fmt: skip
    calm = {
        "infrared.electrons_at_white": 1e9, "infrared.read_noise_e": 0.0, "ambient": 0.05,
        "infrared.psf_px": 0.4, "infrared.speckle_contrast": 0.0,
    }  # fmt: skip
    values = {key: torch.tensor(value, dtype=torch.float64) for key, value in calm.items()}
    made = one.recipe.make(one.mesh, one.id, one.seed, one.renderer)
    true = torch.from_numpy(made.arrays["points_clean"].astype(np.float64))
    points = _points(one.views[0], one.recipe.sensor, values, torch.Generator())
    assert len(points) > 500
    apart = torch.cdist(points, true).min(dim=1).values
    assert float(apart.median()) < 0.03  # m; true points are 2 cm apart, a pixel is 21 cm deep
    ours = one.cloud(values, 400, 0)
    again = one.cloud(values, 400, 0)
    assert torch.equal(ours, again)  # the same noise at each call


def test_the_twin_amplifies_where_the_longest_exposure_is_not_enough():
    """Noise as of so many electrons fewer; where the amplifier ends, the picture stays dark."""
    (one,) = stills(1)
    sensor, view = one.recipe.sensor, one.views[0]

    def points(electrons, **limits):
        camera = replace(sensor.infrared, read_noise_e=0.0, **limits)
        values = {"infrared.electrons_at_white": torch.tensor(electrons, dtype=torch.float64)}
        noise = torch.Generator().manual_seed(0)
        return _points(view, replace(sensor, infrared=camera), values, noise)

    few = points(500.0, fixed_gain=200.0)
    torch.testing.assert_close(points(5000.0, fixed_gain=200.0, max_exposure=20.0), few)
    plain = points(1e4)
    assert torch.equal(points(1e4, max_exposure=1e4), plain)
    dark = points(1e4, max_exposure=0.01)
    assert (dark - plain).abs().median() > 0.05  # m: nothing is matched in the dark


@pytest.mark.slow
def test_the_real_sensor_comes_to_hidden_light_that_it_then_has_on_other_objects():
    """Of the same objects, so that nothing but the light is between source and target.

    One number: fewer electrons and more light change clouds alike, and with both hidden neither is
    found. With few objects of its own the target's distance to the source is that of their shapes.
    """
    every = stills(32, "sensor.ambient=1.0", "limit=24")
    sources, others = every[::2], every[1::2]
    assert (len(sources), len(others)) == (16, 16)
    hidden = {"ambient": 4.0}
    seen, held_out = (
        Distance(roughness, [one.measured(hidden, 512) for one in some])
        for some in (sources, others)
    )
    start = parameters.free(parameters.values_of(sources[0].recipe.sensor, tuple(hidden))).tolist()
    state = State("", start, [0.0], [0.0])
    search(state, tuple(hidden), sources, seen, steps=12, batch=8, points=512, rate=0.5, seed=0)
    found = parameters.as_floats(parameters.bounded(torch.tensor(settled(state)), tuple(hidden)))
    assert 2 < found["ambient"] < 8
    before, after = (
        float(held_out([one.measured(values, 512) for one in others])) for values in ({}, found)
    )
    assert after < 0.3 * before


@pytest.fixture(scope="module")
def target(tmp_path_factory):
    place = tmp_path_factory.mktemp("target")
    words = ["domain=modelnet10", "classes=[chair,sofa]", "limit=4", "workers=0", "splits=[train]"]
    generate(compose("generate", [*words, f"paths.data_dir={place}"]))
    return place / "modelnet10"


def words(target, out, *more):
    return [
        "tune", f"target={target}", f"out={out}", "domain=specklenet10", "views=1",
        "sensor=speckle_stereo_small", "renderer=mitsuba", "renderer.samples=1", "objects=4",
        "held_out=4", "batch=2", "points=128", "classes=[chair,sofa]", "limit=4", "sample=6",
        "parameters=ambient,infrared.psf_px", *more,
    ]  # fmt: skip


def test_the_command_writes_a_preset_that_composes_and_goes_on(target, tmp_path, capsys):
    out = tmp_path / "sensor" / "tuned.yaml"
    out.parent.mkdir()
    assert main(words(target, out, "steps=2")) == 0
    said = capsys.readouterr().out
    assert "held out" in said
    assert "infrared.psf_px" in said
    preset = yaml.safe_load(out.read_text())
    assert preset["defaults"] == ["speckle_stereo_small", "_self_"]
    assert out.read_text().splitlines()[1].startswith("# qs3 tune target=")
    found = build(composed(None, f"hydra.searchpath=[file://{tmp_path}]", "+sensor=tuned").sensor)
    assert isinstance(found, SpeckleStereo)
    assert found.ambient == pytest.approx(preset["ambient"])
    assert found.infrared.electrons_at_white == 10_000
    page = out.with_suffix(".md").read_text()
    assert "| `ambient` | 0.003 to 5 | 0.15 |" in page
    # The search is done: the same command only measures, and comes to the same.
    before = out.read_text()
    assert main(words(target, out, "steps=2")) == 0
    assert out.read_text() == before
    assert main(words(target, out, "steps=2", "rate=0.3")) == 1
    assert "other settings" in capsys.readouterr().err


def test_a_search_is_known_by_the_objects_that_it_searches_with():
    """Not by how many are drawn in all, nor by their names alone."""
    cfg = composed_recipe([*TINY, "classes=[chair,sofa]", "limit=6"])
    items = [item for item in mesh_items(cfg) if item.split == "train"][:9]
    names = ("sample", "steps", "batch", "points", "features", "slopes", "rate", "seed")
    given = {**dict.fromkeys(names, 1), "target": None, "out": None, "parameters": ()}

    def known(objects, held_out, items=items):
        wanted = Wanted(**given, objects=objects, held_out=held_out)
        trained, _ = _drawn(items, wanted)
        return _settings(wanted, cfg, trained, "d", ("ambient",), roughness)

    assert len(items) == 9
    assert known(4, 5) == known(4, 4) != known(5, 4)
    others = [replace(a, load=b.load) for a, b in zip(items, items[::-1], strict=True)]
    assert known(4, 5, others) != known(4, 5)


def test_a_preset_is_not_written_over_the_one_that_it_begins_with(target, tmp_path, capsys):
    out = tmp_path / "speckle_stereo_small.yaml"
    assert main(words(target, out, "steps=1")) == 1
    assert "speckle_stereo_small itself: its values would be lost" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_another_net_under_its_name_is_another_search(target, tmp_path, capsys):
    net, out = tmp_path / "net.pt", tmp_path / "tuned.yaml"
    result = read_result("pointnet-speckle")
    write_result(net, result)
    given = words(target, out, "steps=1", f"features={net}")
    assert main(given) == 0
    changed = {name: value + 1 for name, value in result.weights.items()}
    write_result(net, replace(result, weights=changed))
    assert main(given) == 1
    assert "other settings" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["sensor.ambient=1"], "begins with a preset as it is"),
        (["materials=mixed"], "leave materials= out"),
        (["batch=5"], "batch= is of the objects="),
        (["objects=400"], "are more than"),
        (["features=dgcnn-rooms"], "sees sizes"),
        (["parameters=baseline_m"], "cannot be tuned"),
    ],
)
def test_what_cannot_be_tuned_is_said(more, message, target, tmp_path, capsys):
    given = {word.partition("=")[0]: word for word in words(target, tmp_path / "a.yaml")[1:]}
    given |= {word.partition("=")[0]: word for word in more}
    assert main(["tune", *given.values()]) == 1
    assert message in capsys.readouterr().err


def test_sensors_without_a_twin_are_refused():
    cfg = composed_recipe(["domain=specklenet10_kinect", "renderer=mitsuba"])
    with pytest.raises(ConfigError, match="only active stereo sensors"):
        check_recipe(build(cfg.recipe))
