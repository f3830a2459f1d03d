"""Objects cut from single depth images: what a camera saw of a thing from one place.

    images.py      a depth image with its camera and its vertical, and the points of its pixels
    rules.py       what counts as an object that can be used, and which are clean; with reasons
    pieces.py      pixels that hang together in depth
    outline.py     how much of an object the picture cuts off, and what stands before it
    cutting.py     one object by its mask, or by an oriented box less the floor
    pointed.py     objects that a user points at, by a mask or a box in pixels; cautions, no refusal
    given.py       depth images, masks and intrinsics in a user's files
    vertical.py    which way is up: a fitted floor, an accelerometer, or the planes of a room
    matlab.py      MATLAB's files of both kinds, read with distrust
    nyuv2.py       nyu_depth_v2_labeled.mat, one frame at a time
    sunrgbd.py     SUN RGB-D's archive, one frame at a time

`cutting.cut` needs one depth image and a mask, and nothing else of this package's readers. The
importers that make domains of it are in `qs3.datasets.importers`.
"""
