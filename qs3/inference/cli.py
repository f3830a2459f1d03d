"""`qs3 predict` and `qs3 export`."""

from __future__ import annotations

import os
from typing import Any

from qs3.utils.cli import FLAG, NUMBER, Command, Option, several, text, whole

_CKPT = Option(
    "ckpt", text("RUN"), "a finished run's or an exported folder, or result.pt", required=True
)
_CKPT_OR_OWN = Option(
    "ckpt", text("RUN"), "a run's or exported folder, result.pt, or a name (default: see below)", ""
)
_PACKAGES = Option(
    "packages", several(text("NAME")), "packages or modules that define a net of your own", ()
)
_THREADS = Option("threads", whole(), "batches at the same time (default: one a processor)")


def _predict(threads: int | None, **given: Any) -> int:
    from qs3.inference.command import predict_command
    from qs3.inference.settings import Settings

    said, failed = predict_command(Settings(threads=threads or _processors(), **given))
    print(said)
    return 1 if failed else 0


def _export(threads: int | None, **given: Any) -> None:
    from qs3.inference.export import export_command

    print(export_command(threads=threads or _processors(), **given))


def _processors() -> int:
    return len(os.sched_getaffinity(0))


PREDICT = Command(
    "qs3 predict",
    "classes and confidences of your clouds, or of objects in your depth images",
    _predict,
    (
        _CKPT_OR_OWN,
        Option(
            "second",
            text("RUN"),
            "another one to ask, for column second (see below), or none",
            "",
        ),
        Option(
            "input",
            text("PATH"),
            "clouds (also without input=): a file, a folder, or an archive",
            "",
        ),
        Option("depth", text("PATH"), "or depth images: a .png or .npy, a folder, or a list", ""),
        Option("mask", text("PATH"), "image of objects' numbers; a folder if depth is one", ""),
        Option("box", text("L,T,R,B"), "or the object's left,top,right,bottom in pixels", ""),
        Option("intrinsics", text("F,F,C,C|FILE"), "of the depth camera: fx,fy,cx,cy", ""),
        Option("depth_scale", NUMBER, "metres a unit (default: 0.001; 1 of floats)"),
        Option("up", text("AXIS|X,Y,Z"), "clouds: x y z -x -y or -z; depth: see below", ""),
        Option("floor", NUMBER, "clouds: where the floor is on that axis, in metres"),
        Option("camera_height", NUMBER, "depth: of the camera above the floor, in metres"),
        Option("prior", text("rooms|C:N,C:N"), "how common classes are there (see below)", ""),
        Option("prior_power", NUMBER, "how much of that is believed: 0 nothing, 1 all", 0.5),
        Option("part", text("NAME"), "of an archive of objects (default: adapt; or all)", ""),
        Option("sample", whole(), "only so many objects, drawn at random, always the same"),
        Option("out", text("FILE"), ".csv or .json", "predictions.csv"),
        Option("page", FLAG, "also a page with pictures, FILE.html", True),
        Option("batch_size", whole(), "clouds that the net sees at a time", 16),
        _THREADS,
        Option("device", text("DEVICE"), "cpu, cuda or cuda:1", "cpu"),
        _PACKAGES,
    ),
    (
        "qs3 predict scans",
        "qs3 predict ckpt=logs/own_scans/seed0-5f0c2a71 input=scans",
        "qs3 predict ckpt=RUN depth=frame.png mask=mask.png intrinsics=525,525,319.5,239.5",
        "qs3 predict ckpt=RUN depth=a.npy box=210,95,480,430 intrinsics=cam.yaml up=0,-0.97,-0.24",
        "qs3 predict ckpt=result.pt depth=objects.csv intrinsics=camera.json out=said.json",
    ),
    about="""
Without ckpt= a classifier of ten classes that comes with qs3 is taken, and what it is worth on real
objects is said: dgcnn-rooms, which knows sizes and heights and is right more often, where floor= or
camera_height= is given or an archive's lowest points tell; else dgcnn-speckle, for any unit.

CLOUDS are .xyz .txt .npy .npz .ply .pcd .h5 .hdf5, in any depth of folders: any number of points,
any unit, any place. A net that knows sizes takes them as metres; one that knows heights wants
floor=, which is 0 if objects stand on z = 0. Which way is up is not guessed (default z), and the
wrong axis costs most of the accuracy. Labels: the file's own, or a folder called as a class.

DEPTH IMAGES are .png of 16 bits, in millimetres, or .npy; 0 and 65535 are not measured. A mask has
0 where no object is and a number for each object. A list is .csv, .json or .yaml with a row an
object or a picture: depth, mask, object (number in the mask), box, intrinsics, up, depth_scale,
label; files are relative to it, and what is empty holds as given here. up=x,y,z is up in the
camera's frame (x right, y down, z forward), at any length: what an accelerometer at rest reads, in
these axes. -y is a level camera. Without it planes of the picture tell, else it counts as level.

prior=rooms takes classes as common as in ScanNet's rooms (42 % chairs), prior=chair:4,bathtub:0 as
in your place: others count as 1, 0 is never. More answers are right then, fewer of rare classes.

A row for each object: file (name[3] is cloud 3 of a file, or object 3 of a mask), status, class,
confidence, second (the class that another net names, pointnet-speckle without ckpt=: where the two
differ, look yourself), label, points, dropped (NaN, infinite or 0 0 0: without depth), tier
(clean, hard, or poor, what datasets leave out), caution, up, out_of_range, reason, p_<class> each.

out_of_range=yes: a cloud unlike all those of training (fewer points than the net samples and than
training had; spacing, flatness, height or stray points outside what 99.8 % of them had). It
guarantees nothing: an object of no known class also gets a class, often with high confidence.
The page shows the objects: with labels the errors first, the most confident before the others.
A damaged file gets status=failed and its reason, and the others go on. The exit status is then 1.
""",
    bare="input",
    interrupted="out= was not written",
)

EXPORT = Command(
    "qs3 export",
    "a trained net for use without qs3 (ONNX, torch.export), or as a folder to publish",
    _export,
    (
        _CKPT,
        Option("out", text("PATH"), ".onnx, .pt2 for torch.export.load, or a folder", "model.onnx"),
        Option("judged", text("FILE"), "folder: .json of qs3 report judge, for the card", ""),
        Option("half", FLAG, "folder: matrices in 16 bits, half the size", False),
        _THREADS,
        _PACKAGES,
    ),
    (
        "qs3 export ckpt=logs/own_scans/seed0-5f0c2a71 out=model.onnx",
        "qs3 export ckpt=result.pt out=model.pt2",
        "qs3 export ckpt=logs/own_scans/seed0-5f0c2a71 out=my-classifier",
    ),
    about="""
It takes prepared clouds [clouds, points, 3] and gives logits; how a cloud is prepared, and the
names of the classes, stand in the .onnx file's metadata. The written net is run on made-up clouds
and its logits compared with the net's.

A folder gets model.safetensors, config.json (settings, and the weights' SHA-256) and README.md, the
model's card with what the run knows of data, command and accuracy: the layout of model hubs.
qs3.load and `qs3 predict ckpt=FOLDER` read it; nothing in it is run, damage is refused.
""",
    interrupted="nothing was saved",
)
