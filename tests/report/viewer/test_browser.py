"""The page in a browser: points are where they should be, of their colour, and turn."""

import numpy as np
import pytest
from matplotlib import colormaps

from qs3.geometry.orthographic import AZIMUTH_DEG, ELEVATION_DEG, axes_of
from qs3.report.viewer.page import Part, Shown, page
from tests.report.viewer.browser import chromium, needs_chromium
from tests.report.viewer.test_page import HOSTILE

pytestmark = [needs_chromium, pytest.mark.slow]
PAPER = np.array([247, 248, 250])
PALE = np.array([237, 240, 245])


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as one:
        yield one


@pytest.fixture
def show(browser, tmp_path):
    """Opens a page of clouds; at the end nothing was said or loaded."""

    def opened(*shown, size=(1000, 900), title="title", colour="", **known):
        file = tmp_path / "view.html"
        file.write_text(page(title, [Part(shown, "about", **known)], colour=colour))
        browser.open(file, *size)
        return browser

    yield opened
    assert browser.said == []
    assert [url for url in browser.loaded if not url.endswith("/view.html")] == []


def places(browser):
    """[left, top, side] of each canvas on the screen."""
    return browser.run(
        "return [...document.querySelectorAll('canvas')].map((c) => c.getBoundingClientRect())"
        ".map((b) => [b.left, b.top, b.width])"
    )


def pictures(browser):
    """[h, w, 3] of each canvas, as on the screen, without what shares its outermost pixels."""
    seen = browser.seen()
    found = []
    for left, top, side in places(browser):
        x, y, ends = int(np.ceil(left)), int(np.ceil(top)), np.floor([left + side, top + side])
        found.append(seen[y : int(ends[1]), x : int(ends[0])])
    return found


def drawn(picture):
    return int((picture != PAPER).any(axis=2).sum())


def choose(browser, name, value):
    """As a user with a control: a checkbox, a list, a text."""
    browser.run(
        f"const input = document.getElementById('{name}');"
        f"input[input.type === 'checkbox' ? 'checked' : 'value'] = {value};"
        "for (const kind of ['input', 'change']) input.dispatchEvent(new Event(kind));"
    )
    browser.settle()


def count(browser):
    return browser.run("return [...document.querySelectorAll('.card')].filter("
                       "(c) => c.offsetParent).length")  # fmt: skip


def ball(points=500, seed=0):
    x = np.random.default_rng(seed).normal(size=(points, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def test_hostile_names_are_text_and_all_clouds_are_drawn_in_their_colours(show):
    shown = [Shown(name, ball(seed=i), label=name) for i, name in enumerate(HOSTILE)]
    browser = show(*shown, title=HOSTILE[0], colour="class", failed=HOSTILE, size=(1000, 1600))
    seen = pictures(browser)
    assert len(seen) == len(HOSTILE)
    order = np.argsort(np.argsort(HOSTILE))  # colours are those of the classes by their names
    for picture, colour in zip(seen, colormaps["tab10"](order)[:, :3] * 255, strict=True):
        # A mixture of the class's colour and the pale one of what is far, darker at its rim.
        pixels = picture[(picture != PAPER).any(axis=2)]
        mixed, *_ = np.linalg.lstsq(np.stack([colour, PALE], axis=1), pixels.T, rcond=None)
        off = np.abs(mixed.T @ np.stack([colour, PALE]) - pixels).max(axis=1)
        assert (off < 2).all()
        assert (mixed[0] > 0.2).all()
        assert len(pixels) > 2000
    texts = browser.run("return [...document.querySelectorAll('.card')].map((c) => c.textContent)")
    for name, text in zip(HOSTILE, texts, strict=True):
        assert text.startswith(name.replace("\udcff", "\ufffd")) or "\udcff" in name
    assert browser.run("return document.querySelectorAll('img').length") == 0


def test_points_are_where_the_formulas_of_all_pictures_put_them(show):
    """Each alone on its pixels, paler the farther; turned, moved and enlarged by hand."""
    corners = np.array(
        [[1, 0, 0], [0, 1.0, 0.3], [-0.2, -0.9, -0.6], [0.1, 0.2, 0.9], [-1, 0.1, 0]]
    )
    browser = show(Shown("a", corners), size=(800, 800))
    ((left, top, side),) = places(browser)
    middle = (left + side / 2, top + side / 2)

    def beside(across, down):
        return middle[0] + across * side, middle[1] + down * side

    found = pictures(browser)
    browser.drag(middle, beside(1 / 8, -1 / 16))
    found += pictures(browser)
    browser.drag(middle, beside(1 / 10, 1 / 20), modifiers=8)
    x, y = middle
    browser.send("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-100)
    browser.settle()
    found += pictures(browser)
    turned = (AZIMUTH_DEG - 240 / 8, ELEVATION_DEG - 240 / 16)
    eyes = [((AZIMUTH_DEG, ELEVATION_DEG), 1, (0, 0)), (turned, 1, (0, 0))]
    eyes += [(turned, np.exp(100 / 400), (0.1, 0.05))]
    centred = corners - (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = np.linalg.norm(centred, axis=1).max()
    height = np.interp(corners[:, 2], [-0.6, 0.9], [0.02, 0.88])
    for picture, (angles, zoom, moved) in zip(found, eyes, strict=True):
        right, up, near = axes_of(*angles)
        there = 0
        for point, share in zip(centred / radius, height, strict=True):
            column = side * (0.5 + moved[0] + 0.48 * zoom * (point @ right))
            row = side * (0.5 + moved[1] - 0.48 * zoom * (point @ up))
            if not (20 < column < side - 20 and 20 < row < side - 20):
                continue
            fresh = 0.35 + 0.325 * (1 + point @ near)
            colour = 255 * np.array(colormaps["viridis"](share)[:3])
            around = picture[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2]
            wanted = fresh * colour + (1 - fresh) * PALE
            np.testing.assert_allclose(around.reshape(-1, 3).mean(axis=0), wanted, atol=9)
            there += 1
        assert there >= 4


def test_what_the_controls_do(show):
    known = {"view": np.arange(500) % 3, "residual": np.linspace(0, 1, 500)}
    browser = show(
        Shown("one/a", ball(), label="chair", called="sofa", sure=0.9, **known),
        Shown("two/b", ball() * [1, 1, 0.1], label="sofa", called="sofa", sure=0.2),
        Shown("three/c", 3 * ball(), label="bed"),
        residual_of="distance to the mesh",
    )
    first = pictures(browser)
    assert min(map(drawn, first)) > 2000
    texts = browser.run("return [...document.querySelectorAll('.card')].map((c) => c.textContent)")
    assert "sofa 90% is chair" in texts[0]
    assert "sofa 20% right" in texts[1]
    assert "bed" in texts[2]
    legends, colours = {}, {}
    for mode in ("height", "view", "residual", "class", "confidence"):
        choose(browser, "colour", f"'{mode}'")
        legends[mode] = browser.run("return document.getElementById('legend').textContent")
        colours[mode] = len(np.unique(pictures(browser)[0].reshape(-1, 3), axis=0))
    assert legends == {
        "height": "lowhigh", "view": "view 0view 1view 2", "class": "bedchairsofa",
        "residual": "01 or morenot knowndistance to the mesh", "confidence": "0%100%",
    }  # fmt: skip
    assert colours["residual"] > 3 * colours["class"]

    choose(browser, "colour", "'height'")
    choose(browser, "true-size", "true")
    real = pictures(browser)
    assert drawn(real[0]) < drawn(first[0]) / 4  # a third of the largest
    np.testing.assert_array_equal(real[2], first[2])
    choose(browser, "true-size", "false")
    for words, cards in (("wrong", 1), ("sofa", 2), ("sofa two", 1), ("", 3)):
        choose(browser, "words", f"'{words}'")
        assert count(browser) == cards, words

    # One alone, then all together.
    left, top, side = places(browser)[0]
    start = (left + side / 2, top + side / 2)
    choose(browser, "together", "false")
    browser.drag(start, (start[0] + 40, start[1]))
    alone = pictures(browser)
    assert [(a != f).any() for a, f in zip(alone, first, strict=True)] == [True, False, False]
    choose(browser, "together", "true")
    browser.drag(start, (start[0] + 40, start[1]))
    assert all((a != f).any() for a, f in zip(pictures(browser), first, strict=True))
    browser.run("document.getElementById('reset').click()")
    browser.settle()
    np.testing.assert_array_equal(pictures(browser), first)

    browser.drag(start, start)  # a click
    assert count(browser) == 1
    assert places(browser)[0][2] > 2 * side
    browser.run("document.getElementById('after').click()")
    assert browser.run("return document.getElementById('list').value") == "1"
    for kind in ("keyDown", "keyUp"):
        browser.send("Input.dispatchKeyEvent", type=kind, key="Escape")
    assert count(browser) == 3


def test_two_fingers_enlarge_and_one_turns(show):
    cloud = np.concatenate([0.2 * ball(), [[1, 0, 0], [-1, 0, 0]]])
    browser = show(Shown("a", cloud), size=(800, 800))
    ((left, top, side),) = places(browser)
    x, y = left + side / 2, top + side / 2
    before = pictures(browser)[0]
    browser.touch("touchStart", (x - 20, y), (x + 20, y))
    browser.touch("touchMove", (x - 40, y), (x + 40, y))
    browser.touch("touchEnd")
    browser.settle()
    larger = pictures(browser)[0]
    assert drawn(larger) > 2 * drawn(before)
    browser.touch("touchStart", (x, y))
    browser.touch("touchMove", (x + 60, y))
    browser.touch("touchEnd")
    browser.settle()
    assert (pictures(browser)[0] != larger).any()


def test_many_clouds_are_drawn_when_they_come_into_sight(show):
    browser = show(*(Shown(str(i), ball(64, seed=i)) for i in range(200)))
    sides = "return [...document.querySelectorAll('canvas')].filter((c) => c.width !== 300).length"
    assert 0 < browser.run(sides) < 60
    browser.run("document.querySelectorAll('.card')[199].scrollIntoView()")
    browser.settle()
    assert drawn(pictures(browser)[199]) > 1000
