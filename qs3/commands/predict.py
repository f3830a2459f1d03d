"""`qs3 predict` and `qs3 export`."""

import time
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt

from qs3.errors import ConfigError


def predict(
    input: Annotated[Path | None, "clouds: a file or a folder"] = None,
    *,
    ckpt: Annotated[str, "a run's or exported folder, result.pt, or a name (default: below)"] = "",
    second: Annotated[str, "another one, for column second, or none (default: below)"] = "",
    depth: Annotated[Path | None, "or depth images: a .png or .npy, or a folder"] = None,
    mask: Annotated[Path | None, "image of objects' numbers; a folder if depth is one"] = None,
    box: Annotated[tuple[float, ...] | None, "or the object's left,top,right,bottom in px"] = None,
    intrinsics: Annotated[str, "of the depth camera: fx,fy,cx,cy, or a file"] = "",
    depth_scale: Annotated[
        float | None, Gt(0), Le(1), "metres a unit (default: 0.001; 1 of floats)"
    ] = None,
    up: Annotated[str, "clouds: x y z -x -y or -z (default: z); depth: x,y,z, see below"] = "",
    floor: Annotated[
        float | None, Gt(-30), Lt(30), "where the floor is on that axis, in metres"
    ] = None,
    camera_height: Annotated[
        float | None, Gt(0), Lt(30), "of a camera at the origin above the floor, in metres"
    ] = None,
    prior: Annotated[str, "how common classes are: rooms, or CLASS:N,CLASS:N"] = "",
    prior_power: Annotated[float, Ge(0), "how much of that is believed: 0 nothing, 1 all"] = 0.5,
    out: Annotated[Path, "table, .csv"] = Path("predictions.csv"),
    page: Annotated[bool, "also a page with pictures, .html"] = True,
    batch_size: Annotated[int, Ge(1), "clouds that the net sees at a time"] = 16,
    threads: Annotated[int | None, Ge(1), "batches at the same time (default: processors)"] = None,
    device: Annotated[str, "cpu, cuda or cuda:1"] = "cpu",
    packages: Annotated[tuple[str, ...], "packages that define a net of your own"] = (),
) -> int:
    """Classes and confidences of your clouds, or of objects in your depth images.

    Without ckpt= a classifier of ten classes that comes with qs3 is taken: dgcnn-rooms, which knows
    sizes and heights and is right more often, if floor= or camera_height= is given, with
    second=dgcnn-speckle; else dgcnn-speckle, for clouds in any unit.

    CLOUDS are .xyz .txt .npy .npz .ply .pcd .h5 .hdf5, in any depth of folders. A net that knows
    sizes takes them as metres; one that knows heights needs floor=, 0 if objects stand on z = 0.
    Which way is up is not guessed. Labels: the file's own, or a folder called as a class.

    DEPTH IMAGES are .png of 16 bits, in millimetres, or .npy; 0 and 65535 are not measured. A mask
    has 0 where no object is and a number for each object. up=x,y,z is up in the camera's frame (x
    right, y down, z forward), at any length; -y is a level camera. Without it the planes of the
    picture tell, else the camera counts as level.

    A row for each object: file (name[3] is cloud 3 of a file, or object 3 of a mask), second (the
    class by another net), dropped (points NaN, infinite or 0 0 0: without depth), tier (clean,
    hard, or poor), out_of_range (unlike the clouds of training), ... An object of no known class
    also gets a class, often with high confidence. A damaged file gets status=failed and its reason,
    and the others go on; the exit status is then 1.

    Example:
        qs3 predict scans ckpt=logs/own_scans/seed0-5f0c2a71
        qs3 predict depth=frame.png mask=mask.png intrinsics=525,525,319.5,239.5 camera_height=1.2
        qs3 predict ckpt=RUN depth=a.npy box=210,95,480,430 intrinsics=cam.yaml up=0,-0.97,-0.24
    """
    from qs3.inference import inputs, model_file
    from qs3.inference import page as pages
    from qs3.inference import predict as steps
    from qs3.inference.predictor import load
    from qs3.utils.files import write_text
    from qs3.utils.processor import cores
    from qs3.utils.progress import progress_bar
    from qs3.utils.text_table import printable

    if (input is None) == (depth is None):
        raise ConfigError("give input=PATH for clouds, or depth=PATH for depth images")
    floor = floor if camera_height is None else -camera_height
    name = ckpt or (model_file.ANY_SIZE if floor is None else model_file.HEIGHTS)
    how: dict[str, Any] = {"device": device, "packages": (*model_file.PACKAGES, *packages)}
    how |= {"prior": prior or None, "prior_power": prior_power}
    first = load(name, **how)
    other = second or (model_file.ANY_SIZE if name == model_file.HEIGHTS else "none")
    opinion = None if other == "none" else steps.second_opinion(other, first, floor, **how)
    if depth is None:
        assert input is not None
        found = inputs.clouds(input, up or "z", first.classes)
    else:
        gravity = first.result.gravity
        found = inputs.depth_images(depth, mask, box, intrinsics, depth_scale, up, gravity)
    samples, shown, began = [], [], time.monotonic()
    with progress_bar(f"{found.kind}s read", total=len(found.units)) as advance:
        settings = (first.floor(floor), opinion, batch_size, threads or len(cores()), advance)
        for one in steps.predict_units(first, found.units, *settings):
            samples.append(one)
            shown += [one] * bool(one.cls)
            if len(shown) > pages.MOST_SHOWN + batch_size:
                shown = pages.first_of(shown, first.classes)
    rate = len(samples) / max(time.monotonic() - began, 1e-9)
    notes = steps.notes(first, found.kind, floor is not None)
    data, worth = first.result.data, first.result.worth
    lines = [
        *([] if ckpt else [f"classifier: {name}, which comes with qs3 (ckpt=)"]),
        *notes,
        f"{len(samples)} clouds, {rate:.1f} clouds a second, from {len(found.units)} {found.kind}s",
        *found.notes,
        *steps.summary(samples, first.classes),
        *([f"the classifier's data: {data}"] if data else []),
        *([f"accuracy on real objects: {worth}"] if worth else []),
        f"saved {out}",
    ]
    write_text(out, steps.as_csv(samples, first.classes))
    if page:
        about = {"trained_on": data, "worth": worth, "notes": notes}
        html = pages.page(
            printable(f"{(input or depth or Path()).absolute().name}, as {name} sees it"),
            samples,
            pages.first_of(shown, first.classes),
            first.classes,
            first.floor(floor) if first.needs_floor else None,
            **about,
        )
        write_text(out.with_suffix(".html"), html)
        lines.append(f"saved {out.with_suffix('.html')}")
    print("\n".join(map(printable, lines)))
    return int(not all(one.cls for one in samples))


def export(
    ckpt: Annotated[str, "a finished run's or an exported folder, result.pt, or a name"],
    *,
    out: Annotated[Path, ".onnx, .pt2 for torch.export.load, or a folder"] = Path("model.onnx"),
    half: Annotated[bool, "folder: matrices in 16 bits, half the size"] = False,
    packages: Annotated[tuple[str, ...], "packages that define a net of your own"] = (),
) -> None:
    """A trained net for use without qs3 (ONNX, torch.export), or as a folder to publish.

    A file takes prepared clouds [clouds, points, 3] and gives logits; how a cloud is prepared, and
    the names of the classes, are in the .onnx file's metadata. It is run on made-up clouds and its
    logits compared with the net's. A folder gets model.safetensors, config.json and README.md, the
    model's card: the layout of model hubs. qs3.load and `qs3 predict ckpt=FOLDER` read it.

    Example:
        qs3 export logs/own_scans/seed0-5f0c2a71 out=model.onnx
        qs3 export logs/own_scans/seed0-5f0c2a71 out=my-classifier
    """
    from qs3.inference.export import export_file, export_folder
    from qs3.inference.model_file import PACKAGES

    allowed = (*PACKAGES, *packages)
    file = bool(out.suffix)
    print(export_file(ckpt, out, allowed) if file else export_folder(ckpt, out, half, allowed))
