"""Windows of mostly empty images: where a convolutional network sees anything but emptiness.

A 3x3 convolution carries a filled pixel one pixel on, so after a few of them all maps are, some
pixels away from what is filled, those of an EMPTY image: the same for all images. A layer
therefore needs of each image only a window, and the empty image once, with the number of images
that show it at each pixel. That is exact, in both directions:

- A window is one pixel larger on each side than what is reached: its rim. There a convolution of
  the window alone lacks neighbours, but its result is known: the empty image's. A side on the
  image's border has no rim, because nothing is missing there.
- Backwards a network is linear. Where images show the same, their gradients can be added up first
  and sent back through the empty image once. Before each convolution's gradient the window's rim
  is added to that sum and set to 0: what is left does not reach out of the window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

ROUND = 16  # sizes of windows are multiples: for each new size oneDNN makes new code
WORTH = 0.85  # windows that cover more of the images than this are not worth the trouble


@dataclass(frozen=True)
class Piece:
    """Windows of one size [h, w], few enough to be worked on at once.

    Attributes:
        images: which image each window is of.
        corners: (top, left) of each.
        rim: where in the flat [i * h * w] pixels of the windows the rims lie: int64 [r].
        under: the same pixels in the flat empty image: int64 [r].
    """

    h: int
    w: int
    images: tuple[int, ...]
    corners: tuple[tuple[int, int], ...]
    rim: Tensor
    under: Tensor


@dataclass(frozen=True)
class Layout:
    """How the maps [images, h, w, c] of one stage are kept: as a list of pieces.

    With windows the empty image [1, h, w, c] comes before all pieces. Each image is in one piece.

    Attributes:
        h, w, images: of the whole maps.
        pieces: windows, or groups of whole images.
        empty: how many images show the empty image at each pixel: int64 [h * w]. None without
            windows.
    """

    h: int
    w: int
    images: int
    pieces: tuple[Piece, ...]
    empty: Tensor | None

    @property
    def parts(self) -> range:
        """Numbers of the parts of a map's list."""
        return range(len(self.pieces) + (self.empty is not None))

    def piece(self, part: int) -> Piece | None:
        """A part's piece, None for the empty image."""
        if self.empty is None:
            return self.pieces[part]
        return self.pieces[part - 1] if part else None

    def before(self, stride: int, h: int, w: int) -> Layout:
        """The same windows in maps of h x w, of which these here are every `stride`th pixel."""
        nothing = torch.empty(0, dtype=torch.int64)
        pieces = tuple(
            Piece(
                min(stride * p.h, h), min(stride * p.w, w), p.images,
                tuple((stride * top, stride * left) for top, left in p.corners), nothing, nothing,
            )
            for p in self.pieces
        )  # fmt: skip
        return Layout(h, w, self.images, pieces, self.empty)


def whole(images: int, h: int, w: int, at_once: int) -> Layout:
    """Whole images, some in a piece, with `at_once` pixels at most if there are several."""
    nothing = torch.empty(0, dtype=torch.int64)
    step = max(1, at_once // (h * w))
    groups = [tuple(range(i, min(i + step, images))) for i in range(0, images, step)]
    pieces = tuple(Piece(h, w, g, ((0, 0),) * len(g), nothing, nothing) for g in groups)
    return Layout(h, w, images, pieces, None)


def reach(filled: Bool[Tensor, "i n"]) -> tuple[Tensor, Tensor]:
    """First filled position of each image and the one after its last: int64 [i], [i].

    Both are 0 where nothing is filled.
    """
    n = filled.shape[1]
    places = torch.arange(n)
    first = torch.where(filled, places, n).amin(1)
    end = torch.where(filled, places + 1, 0).amax(1)
    return first.minimum(end), end


def windows(
    rows: tuple[Tensor, Tensor], columns: tuple[Tensor, Tensor], h: int, w: int, at_once: int
) -> Layout | None:
    """Windows about rows first to end, columns first to end; None if they are not worth it.

    Args:
        rows, columns: what the filled pixels reach, (first, end), int64 [i] each; it may lie
            beyond the borders.
        h, w: of the whole maps.
        at_once: pixels in a piece, at most, if it has several windows.
    """
    tops, heights = _span(*rows, h)
    lefts, widths = _span(*columns, w)
    images = len(tops)
    if sum(a * b for a, b in zip(heights, widths, strict=True)) > WORTH * images * h * w:
        return None
    groups: dict[tuple[int, int], list[int]] = {}
    for image, size in enumerate(zip(heights, widths, strict=True)):
        groups.setdefault(size, []).append(image)
    pieces = []
    covered = torch.zeros(h, w, dtype=torch.int64)
    for (height, width), members in sorted(groups.items()):
        step = max(1, at_once // (height * width))
        for start in range(0, len(members), step):
            some = members[start : start + step]
            corners = [(tops[image], lefts[image]) for image in some]
            pieces.append(_piece(height, width, some, corners, h, w))
            for top, left in corners:
                covered[top : top + height, left : left + width] += 1
    return Layout(h, w, images, tuple(pieces), (images - covered).flatten())


def _span(first: Tensor, end: Tensor, size: int) -> tuple[list[int], list[int]]:
    """Start and length of windows with a rim, all inside."""
    low, high = (first - 1).clamp_(min=0), (end + 1).clamp_(max=size)
    length = (-(-(high - low).clamp_(min=1) // ROUND) * ROUND).clamp_(max=size)
    return torch.minimum(low, size - length).tolist(), length.tolist()


def _piece(
    h: int, w: int, images: Sequence[int], corners: Sequence[tuple[int, int]], high: int, wide: int
) -> Piece:
    top, left = torch.tensor(corners).T[:, :, None, None]  # [i, 1, 1]
    row, column = torch.arange(h)[:, None], torch.arange(w)
    rim = ((row == 0) & (top > 0)) | ((row == h - 1) & (top + h < high))
    rim = rim | ((column == 0) & (left > 0)) | ((column == w - 1) & (left + w < wide))
    under = ((top + row) * wide + left + column).flatten()  # [i * h * w]
    where = rim.flatten().nonzero()[:, 0]
    return Piece(h, w, tuple(images), tuple(corners), where, under[where])


def cut(maps: Tensor, layout: Layout) -> list[Tensor]:
    """Parts of whole images [i, h, w, c] whose empty image is 0."""
    parts = [torch.zeros_like(maps[:1])] if layout.empty is not None else []
    for p in layout.pieces:
        spots = zip(p.images, p.corners, strict=True)
        parts.append(torch.stack([maps[i, t : t + p.h, u : u + p.w] for i, (t, u) in spots]))
    return parts


def recut(maps: list[Tensor], old: Layout, new: Layout) -> list[Tensor]:
    """The same maps in another layout, whose windows hold all that is not empty."""
    spots = _spots(old)
    parts = [maps[0]] if new.empty is not None else []
    for p in new.pieces:
        out = maps[0].new_empty(len(p.images), p.h, p.w, maps[0].shape[3])
        for to, image, corner in zip(out, p.images, p.corners, strict=True):
            part, row, q, origin = spots[image]
            if old.empty is not None:
                to.copy_(maps[0][0, corner[0] : corner[0] + p.h, corner[1] : corner[1] + p.w])
            inner, outer = _shared(origin, q, corner, p)
            to[outer] = maps[part][row][inner]
        parts.append(out)
    return parts


def recut_back(grads: list[Tensor], old: Layout, new: Layout) -> list[Tensor]:
    """Gradients of `recut`'s result, written over, to those of its maps."""
    spots, c = _spots(old), grads[0].shape[3]
    parts = [grads[0].new_zeros(len(p.images), p.h, p.w, c) for p in old.pieces]
    if old.empty is not None:
        empty = grads[0] if new.empty is not None else grads[0].new_zeros(1, old.h, old.w, c)
        parts.insert(0, empty)
    for g, p in zip(grads[len(grads) - len(new.pieces) :], new.pieces, strict=True):
        for of, image, corner in zip(g, p.images, p.corners, strict=True):
            part, row, q, origin = spots[image]
            inner, outer = _shared(origin, q, corner, p)
            parts[part][row][inner] = of[outer]
            if old.empty is not None:
                of[outer] = 0
                parts[0][0, corner[0] : corner[0] + p.h, corner[1] : corner[1] + p.w] += of
    return parts


def _shared(
    origin: tuple[int, int], q: Piece, corner: tuple[int, int], p: Piece
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The pixels that two windows share, in the one of q and in that of p."""
    spans = []
    for a, n, b, m in zip(origin, (q.h, q.w), corner, (p.h, p.w), strict=True):
        low, high = max(a, b), min(a + n, b + m)
        spans.append((slice(low - a, high - a), slice(low - b, high - b)))
    (top, top2), (left, left2) = spans
    return (top, left), (top2, left2)


def _spots(layout: Layout) -> dict[int, tuple[int, int, Piece, tuple[int, int]]]:
    """Where each image is: part, row in it, its piece, corner."""
    first = int(layout.empty is not None)
    return {
        image: (first + k, row, p, p.corners[row])
        for k, p in enumerate(layout.pieces)
        for row, image in enumerate(p.images)
    }
