"""`qs3 sense`: depth cameras for a simulator. `qs3 match`: their matchers for your own pair."""

from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt


def sense(
    input: Annotated[Path, "perfect depth: a .png of 16 bits or .npy, or a folder of them"],
    *,
    intrinsics: Annotated[str, "fx,fy,cx,cy in px, or a file that has them"],
    sensor: Annotated[tuple[str, ...], "of conf/sensor"] = ("realsense_d435",),
    out: Annotated[Path, ".png (mm) or .npy (m); a folder if the input is one"] = Path("noisy.png"),
    seed: Annotated[int, Ge(0), "of the noise, with a file's place in the folder"] = 0,
    albedo: Annotated[str, "0..1, or a grey picture (folder: of the same names)"] = "0.8",
    ambient: Annotated[float | None, Ge(0), "other light, in the sensor's units"] = None,
    depth_scale: Annotated[
        float | None, Gt(0), "metres a unit (default: 0.001; 1 of floats)"
    ] = None,
    explain: Annotated[bool, "also NAME_why.png: the reason of each pixel, below"] = False,
    picture: Annotated[Path | None, "the first image, all sensors' and why, .png"] = None,
    **overrides: Annotated[str, "settings of all sensors (sensor.KEY), or hydra.searchpath"],
) -> None:
    """Noisy depth, as a real device would measure it, from a simulator's perfect depth.

    Infrared images of the scene with the device's pattern are computed from the depth image, and
    matched as the device does. 0 (.png) or NaN (.npy) is not measured. With several sensors, files
    are called NAME_SENSOR. Pixels of NAME_why.png: 0 measured, 1 empty, 2 not lit by the projector,
    3 hidden from the other camera, 4 outside of its view, 5 dark, 6 too bright, 7 ambiguous,
    8 inconsistent, 9 out of range, 10 filtered, 11 not matched.

    Example:
        qs3 sense depth.png intrinsics=525,525,319.5,239.5 sensor=kinect_v1 out=noisy.png
        qs3 sense frames intrinsics=cam.yaml albedo=grey explain=true out=noisy
    """
    from qs3.datasets.depth_images import read_depth, read_intrinsics
    from qs3.generation import sense as functions

    camera = read_intrinsics(intrinsics)
    words = [f"{key}={value}" for key, value in overrides.items()]
    devices = {name: functions.device(name, *words) for name in sensor}

    def one(place: int, path: Path, target: Path) -> None:
        depth, grey = read_depth(path, depth_scale, camera.depth_scale), _albedo(albedo, path)
        how: Any = {"albedo": grey, "ambient": ambient, "seed": (seed, place), "explain": True}
        found: dict[str, Any] = {}
        for name, model in devices.items():
            found[name] = functions.sense(depth, camera.camera, sensor=model, **how)
            own = target.with_stem(target.stem + f"_{name}" * (len(devices) > 1))
            _write(own, *found[name], explain=explain)
        if picture and place == 0:
            _draw(depth, found, picture)

    _all(one, input, out)


def match(
    left: Annotated[Path, "rectified infrared picture, or a folder of them"],
    right: Annotated[Path, "the right camera's; a folder of the same names"],
    *,
    intrinsics: Annotated[str, "of the left camera: fx,fy,cx,cy in px, or a file"],
    baseline: Annotated[float, Gt(0), "m between the cameras"],
    preset: Annotated[str, "a sensor of conf/sensor with two cameras"] = "realsense_d435",
    num_disparities: Annotated[int | None, Ge(3), "px searched (default: the preset's)"] = None,
    out: Annotated[Path, ".png (mm) or .npy (m); a folder if the input is one"] = Path("depth.png"),
    explain: Annotated[bool, "also NAME_why.png, as of `qs3 sense`"] = False,
) -> None:
    """Depth of your own stereo camera's pictures, by a device's matcher and filters.

    Example:
        qs3 match left.png right.png intrinsics=640,640,423.5,239.5 baseline=0.05
    """
    from qs3.datasets.depth_images import read_intrinsics
    from qs3.generation import sense as functions

    camera = read_intrinsics(intrinsics).camera

    def one(place: int, path: Path, target: Path) -> None:
        pair = _grey(path), _grey(right / path.relative_to(left) if left.is_dir() else right)
        how: Any = {"baseline_m": baseline, "preset": preset, "num_disparities": num_disparities}
        _write(target, *functions.match(*pair, camera, explain=True, **how), explain=explain)

    _all(one, left, out)


def _all(one: Any, place: Path, out: Path) -> None:
    """Call `one` with the number, source and target of each image of a folder, on all cores."""
    from concurrent.futures import ThreadPoolExecutor

    from qs3.inference.inputs import find_files
    from qs3.utils.processor import cores
    from qs3.utils.progress import progress_bar

    jobs = [(0, place, out)]
    if place.is_dir():
        files = find_files(place, (".png", ".npy"))[0]
        jobs = [(k, path, out / path.relative_to(place)) for k, path in enumerate(files)]
    with (
        progress_bar("images", total=len(jobs)) as advance,
        ThreadPoolExecutor(len(cores())) as pool,
    ):
        for _ in pool.map(lambda job: one(*job), jobs):
            advance()
    print(f"saved {out}")


def _grey(path: Path) -> Any:
    """[h, w] uint8 of a picture."""
    import numpy as np
    from PIL import Image

    from qs3.utils.files import reading

    with reading(path), Image.open(path) as image:
        return np.asarray(image.convert("L"))


def _albedo(words: str, path: Path) -> Any:
    try:
        return float(words)
    except ValueError:
        picture = Path(words)
        return _grey(picture / f"{path.stem}.png" if picture.is_dir() else picture) / 255


def _write(path: Path, depth: Any, why: Any, *, explain: bool) -> None:
    """Depth [h, w] in metres as .npy, in millimetres as .png; reasons next to it."""
    import numpy as np
    from PIL import Image

    from qs3.utils.files import atomic_path

    with atomic_path(path) as temporary:
        if path.suffix.lower() == ".npy":
            np.save(temporary, depth)
        else:
            mm = np.rint(np.nan_to_num(depth) * 1000).clip(0, 65534)
            Image.fromarray(mm.astype(np.uint16)).save(temporary)
    if explain:
        with atomic_path(path.with_name(f"{path.stem}_why.png")) as temporary:
            Image.fromarray(why).save(temporary)


def _draw(depth: Any, found: dict[str, Any], path: Path) -> None:
    """A picture of perfect depth next to each sensor's, which stands above its reasons."""
    import numpy as np

    from qs3.generation.kept import reason_image
    from qs3.utils.pictures import save_png, sheet, value_image

    depths = [np.where(depth > 0, depth, np.nan), *(noisy for noisy, _ in found.values())]
    low, high = np.nanpercentile(depths[0], [1, 99])
    whys, reasons = zip(*(reason_image(why) for _, why in found.values()), strict=True)
    images = [value_image(values, low, high, "viridis") for values in depths]
    words = [f"perfect depth, {low:.2f} to {high:.2f} m", *found, "", *whys]
    save_png(sheet([*images, None, *reasons], words, columns=len(depths), panel_in=2.5), path, 64)
