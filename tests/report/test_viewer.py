"""The page of clouds: nothing lost but the last bits, nothing taken for HTML, and small."""

import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qs3.errors import DataError
from qs3.report.viewer import Part, Shown, page, points_each, thinned
from qs3.utils.pictures import AZIMUTH_DEG
from tests.report.pages import data_of, places

RNG = np.random.default_rng(0)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
HOSTILE = (
    '</script><img src=x onerror="alert(1)">', "<!-- <script>", "]]>", "a\u2028b", "\x00\x1b[31m",
    "'\"&amp;<b>",
)  # fmt: skip


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
    assert np.abs(places(found) - (cloud - cloud.min(axis=0))).max() <= side / 65535 * 0.5000001
    farthest = np.linalg.norm(cloud - (cloud.min(axis=0) + cloud.max(axis=0)) / 2, axis=1).max()
    assert found["radius"] == pytest.approx(farthest or 1.0)


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
    hostile = page(HOSTILE[0], [Part(shown, HOSTILE[0], HOSTILE[5], HOSTILE)])
    harmless = [one(str(i), label="a", called="b", sure=0.5, note="c") for i in range(len(shown))]
    usual = page("t", [Part(harmless, "about", "m", ["failed"] * len(HOSTILE))])
    assert Tags(hostile).seen == Tags(usual).seen
    assert Tags(hostile).attributes == Tags(usual).attributes
    found = data_of(hostile)
    assert [cloud["name"] for cloud in found["clouds"]] == list(HOSTILE)
    assert found["unit"] == HOSTILE[5]
    assert not re.search(r"\b(?:https?:|href=|url\(|@import|import\(|fetch\()", usual)


def test_colours_are_those_that_something_is_known_of():
    assert data_of(of(one()))["modes"] == ["height"]
    full = one(label="chair", called="sofa", sure=0.9)
    found = data_of(of(one("b", label="bed"), full))
    assert found["modes"] == ["height", "class", "confidence"]
    assert found["classes"] == ["bed", "chair"]
    assert len(found["class_colours"]) == 2


def test_many_points_are_drawn_from_and_the_page_says_so():
    cloud = np.arange(60.0).reshape(20, 3)
    whole = Shown("a", cloud)
    few = thinned(whole, 7)
    assert few.of == 20
    assert set(few.points[:, 0]) <= set(cloud[:, 0])
    assert thinned(whole, 20) is whole
    text = of(whole, one("b", 5), points=7)
    assert "at most 7 points of a cloud are shown" in text
    assert [(c["count"], c["of"]) for c in data_of(text)["clouds"]] == [(7, 20), (5, 0)]
    assert (points_each(50, None), points_each(1, None), points_each(3, 9)) == (2048, 50_000, 9)
    with pytest.raises(DataError):
        page("t", [Part([], "about", failed=["x: damaged"])])


@pytest.mark.parametrize("azimuth", [0.0, 100.0, -170.0])
def test_a_scan_beside_the_origin_is_seen_from_there(azimuth):
    """Its camera; 20 degrees off, so that depth shows."""
    cloud = RNG.uniform(-0.5, 0.5, (50, 3))
    towards = np.array([np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth)), 0])
    middle = (cloud.min(axis=0) + cloud.max(axis=0)) / 2
    (found,) = data_of(of(Shown("a", cloud - middle - 3 * towards)))["clouds"]
    assert (AZIMUTH_DEG + found["turn"] - azimuth + 180) % 360 - 180 == pytest.approx(-20, abs=0.1)
    assert data_of(of(Shown("a", cloud + 0.2)))["clouds"][0]["turn"] == 0


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_makes_a_card_of_each_cloud(tmp_path):
    (tmp_path / "view.html").write_text(of(one("b", label="bed", called="sofa", sure=0.9), one()))
    words = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    seen = subprocess.run(
        [*words, f"--user-data-dir={tmp_path}", f"file://{tmp_path}/view.html"],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    assert seen.count("<canvas") == 2
    assert "sofa 90%</span> is bed" in seen
