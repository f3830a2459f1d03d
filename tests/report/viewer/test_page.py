"""The page of clouds: nothing lost but the last bits, nothing taken for HTML, and small."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.errors import ConfigError, DataError
from qs3.geometry.orthographic import AZIMUTH_DEG
from qs3.report.viewer import MOST_CLOUDS, MOST_POINTS
from qs3.report.viewer.page import (
    Part,
    Shown,
    nice,
    page,
    points_each,
    thinned,
)
from tests.report.viewer.reading import data_of, levels, places

RNG = np.random.default_rng(0)


def one(name="a", count=8, **known):
    return Shown(name, RNG.normal(size=(count, 3)), **known)


def of(*shown, **given):
    return page("title", [Part(shown, "about")], **given)


@given(
    st.lists(st.tuples(*[st.floats(-1e30, 1e30)] * 3), min_size=1, max_size=9),
    st.floats(1e-30, 1),
)
def test_coordinates_are_off_by_half_a_step_at_most(rows, scale):
    cloud = np.array(rows) * scale
    (found,) = data_of(of(Shown("a", cloud)))["clouds"]
    side = np.ptp(cloud, axis=0).max()
    error = np.abs(places(found) - (cloud - cloud.min(axis=0)))
    assert error.max() <= side / 65535 * 0.5000001
    farthest = np.linalg.norm(cloud - (cloud.min(axis=0) + cloud.max(axis=0)) / 2, axis=1).max()
    assert found["radius"] == pytest.approx(farthest or 1.0)


def test_fifty_clouds_of_2048_points_are_about_a_megabyte():
    plain = [one(f"chair/train/chair_{i:04d}", 2048, label="chair") for i in range(50)]
    assert len(of(*plain)) < 900_000
    known = [
        one(c.name, 2048, view=RNG.integers(0, 5, 2048), residual=RNG.random(2048)) for c in plain
    ]
    assert len(of(*known)) < 1_200_000


HOSTILE = (
    '</script><img src=x onerror="alert(1)">', "<!-- <script>", "]]>", "a\u2028b", "\x00\x1b[31m",
    "'\"&amp;<b>", "\udcff",
)  # fmt: skip


class Tags(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.seen, self.attributes = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.attributes |= {name for name, _ in attrs}


def test_names_stay_text():
    shown = [one(name, label=name, called=name, sure=0.5, note=name) for name in HOSTILE]
    hostile = page(HOSTILE[0], [Part(shown, HOSTILE[0], HOSTILE[5], HOSTILE[1], HOSTILE)])
    hostile.encode()  # can be written
    harmless = [one(str(i), label="a", called="b", sure=0.5, note="c") for i in range(len(shown))]
    usual = page("t", [Part(harmless, "about", "m", "x", ["failed"] * len(HOSTILE))])
    assert Tags(hostile).seen == Tags(usual).seen
    assert Tags(hostile).attributes == Tags(usual).attributes
    found = data_of(hostile)
    assert [cloud["name"] for cloud in found["clouds"]] == list(HOSTILE)
    assert found["unit"] == HOSTILE[5]


def test_nothing_is_loaded_and_only_the_one_script_may_run():
    text = of(one())
    assert not re.search(r"\b(?:https?:|src=|href=|url\(|@import|import\(|fetch\()", text)
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    script, style = re.findall(r"<(?:script|style)>(.*?)</(?:script|style)>", text, re.DOTALL)[::-1]

    def named(content):
        return base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()

    assert policy == (
        f"default-src 'none'; script-src 'sha256-{named(script)}'; "
        f"style-src 'sha256-{named(style)}'"
    )


def test_colours_are_those_that_something_is_known_of():
    assert data_of(of(one()))["modes"] == ["height"]
    full = one(view=np.arange(8), residual=np.arange(8.0), label="chair", called="sofa", sure=0.9)
    found = data_of(of(one("b", label="bed"), full, colour="residual"))
    assert found["modes"] == ["height", "view", "residual", "class", "confidence"]
    assert found["colour"] == "residual"
    assert found["classes"] == ["bed", "chair"]
    assert found["views"] == list(range(8))
    assert len(found["view_colours"]) == 8
    with pytest.raises(ConfigError, match=r"colour=view: nothing is known of it.*provenance=true"):
        of(one(), colour="view")
    with pytest.raises(ConfigError, match=r"colour=class: .*there are height$"):
        of(one(), colour="class")


def test_residuals_have_254_steps_and_a_sign_for_not_known():
    residual = np.array([0.0, 0.01, 0.02, 0.04, 7.0, np.nan, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02])
    found = data_of(of(one(count=12, residual=residual)))
    assert found["residual_most"] == "0.05"  # nine of ten lie below 0.04
    want = [0, 51, 102, 203, 254, 255, *[102] * 6]
    assert levels(found["clouds"][0], "residual").tolist() == want
    (none,) = data_of(of(one(residual=np.full(8, np.nan))))["clouds"]
    assert set(levels(none, "residual")) == {255}


@pytest.mark.parametrize(
    ("value", "rounded"),
    [(0.011, 0.02), (0.02, 0.02), (0.5, 0.5), (0.51, 1), (3, 5), (7, 10), (1, 1), (0, 1), (-1, 1)],
)
def test_scales_are_round(value, rounded):
    assert nice(value) == pytest.approx(rounded)


def test_many_points_are_drawn_from_and_the_page_says_so():
    cloud = np.arange(60.0).reshape(20, 3)
    whole = Shown("a", cloud, view=np.arange(20), residual=np.arange(20.0))
    few = thinned(whole, 7)
    assert len(few.points) == 7
    assert few.of == 20
    np.testing.assert_array_equal(few.points, cloud[few.view])
    np.testing.assert_array_equal(few.view, few.residual)
    np.testing.assert_array_equal(few.view, thinned(whole, 7).view)
    assert thinned(whole, 20) is whole
    text = of(whole, one("b", 5), points=7)
    assert "at most 7 points of a cloud are shown" in text
    assert [(c["count"], c["of"]) for c in data_of(text)["clouds"]] == [(7, 20), (5, 0)]


def test_limits():
    assert points_each(50, None) == 2048
    assert points_each(1, None) == 50_000
    assert points_each(3, 20_000) == 20_000
    for clouds, points, words in (
        (MOST_CLOUDS + 1, None, "a page holds 500 at most"),
        (1, MOST_POINTS + 1, "a cloud on a page has 200000 at most"),
        (50, 100_000, "50 clouds of 100000 points are more than the 3000000 points of a page"),
    ):
        with pytest.raises(ConfigError, match=words):
            points_each(clouds, points)
    with pytest.raises(DataError, match="no cloud to show\nx: damaged"):
        page("t", [Part([], "about", failed=["x: damaged"])])


def test_what_failed_is_told_up_to_ten():
    text = page("t", [Part([one()], "about", failed=[f"file {i}" for i in range(12)])])
    assert "not read: file 9<" in text
    assert "file 10" not in text
    assert "not read: 2 more" in text


def test_a_scan_beside_the_origin_is_seen_from_there():
    """Its camera; 20 degrees off, so that depth shows."""
    cloud = RNG.uniform(-0.5, 0.5, (50, 3))
    for azimuth in (0.0, 100.0, -170.0):
        towards = np.array([np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth)), 0])
        middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
        (found,) = data_of(of(Shown("a", cloud - middle - 3 * towards)))["clouds"]
        seen_from = AZIMUTH_DEG + found["turn"]
        assert (seen_from - azimuth + 180) % 360 - 180 == pytest.approx(-20, abs=0.1)
    assert data_of(of(Shown("a", cloud + 0.2)))["clouds"][0]["turn"] == 0
