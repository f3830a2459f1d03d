"""Loops over the pixels of a depth image, compiled. Imported only when needed.

w is 1 / Z throughout: of a plane it is linear across the image, and seen from a camera that is
moved along x by b, a point at the tangent x = X / Z lies at x - b w, with the same w. All cameras
and projectors look the same way, so a row of one sees what lies in that row of the others.
"""

from typing import Any

import numpy as np

from qs3.utils.processor import compiled

_BIAS = 0.005  # part of w by which an occluder must be nearer to cast a shadow


@compiled
def _draw(
    near: Any, source: Any, a: float, w_a: float, b: float, w_b: float, i: int, j: int
) -> None:
    """Draw a piece of a row from sample `a` to `b`: i's half, then j's. Turned away if b < a."""
    if not b > a:
        return
    first, last = max(int(np.ceil(a)), 0), min(int(np.ceil(b)), len(near))
    slope = (w_b - w_a) / (b - a)
    middle = (a + b) / 2
    for s in range(first, last):
        w = w_a + slope * (s - a)
        if w > near[s]:
            near[s], source[s] = w, i if s < middle else j


@compiled
def _look(
    line: Any, lens: Any, moved: float, start: float, pitch: float, beyond: bool, seen: Any
) -> None:
    """What a row shows from elsewhere: the largest w, and the column that it comes from.

    Args:
        line: w at the height that is looked at, `linked` and `slope_x` of the row.
        lens: (f, c) of the depth image, px.
        moved: b, m.
        start, pitch: tangent of the first sample, and between two.
        beyond: go on with what ends behind something nearer, as far as it comes into view.
        seen: w and column, [n] float32 and int32, are filled: 0 and -1 where nothing is.
    """
    w, linked, slope = line
    near, source = seen
    near[:], source[:] = 0, -1
    f, c = lens
    step, shift, first = 1 / (f * pitch), moved / pitch, -(c / f + start) / pitch
    width = len(w)
    for i in range(width):
        here = w[i]
        if here <= 0:
            continue
        at = i * step - shift * here + first
        if linked[i]:
            there = w[i + 1]
            end = (i + 1) * step - shift * there + first
            _draw(near, source, at, here, end, there, i, i + 1)
            if i > 0 and linked[i - 1]:
                continue
        for side in (-1, 1):
            other = i + side
            inside = 0 <= other < width
            if (side > 0 and linked[i]) or (side < 0 and inside and linked[other]):
                continue
            length = 0.5
            if beyond and inside and w[other] > here:
                length += abs(moved) * (w[other] - here) * f
            elif beyond and not inside:
                length += abs(moved) * here * f
            end_w = here + slope[i] * side * length
            if length > 0.5:  # a guess: not in front of what hides it, nor behind all
                end_w = min(max(end_w, here / 2), max(w[other], here) if inside else 2 * here)
            end = (i + side * length) * step - shift * end_w + first
            if side > 0:
                _draw(near, source, at, here, end, end_w, i, i)
            else:
                _draw(near, source, end, end_w, at, here, i, i)


@compiled
def shade(
    surface: Any, lens: Any, view: Any, samples: int, slide: Any, scale: float, lamp: float,
    light: Any, ambient: Any,
) -> None:  # fmt: skip
    """What a camera sees of a depth image, in the light of a projector and from all sides.

    Args:
        surface: [h, w] each: w, float32; `linked`, bool: the surface goes on to the next column;
            `slope_x` and `slope_y`, the change of w a pixel; the albedo; and albedo times cosine of
            incidence times distance of the light, m, 0 where the surface is turned away.
        lens: (fx, fy, cx, cy) of the depth image, px.
        view: (f, cx, cy, left, top) of the camera and its window, px, and its place along x, m.
        samples: columns of samples in a pixel; there is one row less, and a row's places lie
            between those of the one before.
        slide: [H, W] float32; an empty one is no projector.
        scale: columns and rows of the slide to a tangent of 1.
        lamp: place of the projector along x, m.
        light, ambient: [h, w] float32 of the window, get the light of the projector, for a strength
            of 1, and the albedo, means over the pixels.
    """
    w, linked, slope_x, slope_y, albedo, facing = surface
    height, width = w.shape
    fx, fy, cx, cy = lens
    focal, centre_x, centre_y, left, top, moved = view
    rows, columns = light.shape
    count = columns * samples
    per_pitch, pitch = focal * samples, 1 / (focal * samples)
    high = max(samples - 1, 1)
    line = np.empty(width, dtype=np.float32)
    near, source = np.empty(count, dtype=np.float32), np.empty(count, dtype=np.int32)
    lit_rows, lit_columns = slide.shape
    dark = lit_rows == 0
    # What lies beside the camera's window casts shadows into it: the farther, the nearer it is.
    spare = 0 if dark else min(int(abs(lamp) * w.max() / pitch) + 2, 2 * count)
    lamp_near = np.empty(0 if dark else count + 2 * spare, dtype=np.float32)
    lamp_source = np.empty(len(lamp_near), dtype=np.int32)
    stripe = np.zeros(lit_columns + 2, dtype=np.float32)
    aside_m = moved - lamp
    nearer = np.float32(1 - _BIAS)
    share = np.float32(1 / (samples * high))
    for row in range(rows):
        light[row], ambient[row] = 0, 0
        for k in range(high):
            aside = ((k + 0.5) / high - 0.5) / samples
            start = (left - 0.5 + 0.5 / samples + aside - centre_x) / focal
            lamp_start = start - spare * pitch
            y = (top + row - 0.5 + (k + 0.5) / high - centre_y) / focal
            v = fy * y + cy
            r = int(np.floor(v + 0.5))
            if r < 0 or r >= height:
                continue
            for i in range(width):
                line[i] = w[r, i] + slope_y[r, i] * np.float32(v - r) if w[r, i] > 0 else 0
            here_on = (line, linked[r], slope_x[r])
            _look(here_on, (fx, cx), moved, start, pitch, True, (near, source))
            place = y * scale + lit_rows / 2
            thrown = not dark and 0 <= place <= lit_rows
            if thrown:
                _look(here_on, (fx, cx), lamp, lamp_start, pitch, False, (lamp_near, lamp_source))
                place = min(max(place - 0.5, 0), lit_rows - 1)
                upper = min(int(place), lit_rows - 2) if lit_rows > 1 else 0
                part, lower = np.float32(place - upper), min(upper + 1, lit_rows - 1)
                for i in range(lit_columns):  # the ends go on for half a pixel
                    stripe[i + 1] = slide[upper, i] * (1 - part) + slide[lower, i] * part
                stripe[0], stripe[-1] = stripe[1], stripe[-2]
            for col in range(columns):
                shine, whole = np.float32(0), np.float32(0)
                for s in range(col * samples, (col + 1) * samples):
                    i, here = source[s], near[s]
                    if i < 0:
                        continue
                    whole += albedo[r, i]
                    x = start + s * pitch + aside_m * here
                    place = x * scale + lit_columns / 2
                    if not thrown or place < 0 or place > lit_columns:
                        continue
                    at = (x - lamp_start) * per_pitch
                    if 0 <= at < len(lamp_near) - 1:
                        j = int(at)
                        if here < min(lamp_near[j], lamp_near[j + 1]) * nearer:
                            continue
                    j = int(place + 0.5)
                    t = np.float32(place + 0.5 - j)
                    thrown_here = stripe[j] * (1 - t) + stripe[j + 1] * t
                    shine += facing[r, i] * thrown_here * here * here * here
                light[row, col] += shine * share
                ambient[row, col] += whole * share
