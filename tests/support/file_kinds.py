"""Every kind of input file that is damaged in tests: good samples, how to damage them, and how they are
read."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from langsplat_core.arrays import unit
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import load_colmap
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.datasets.photos import read_photo
from langsplat_core.display.displays import latent_colours
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.io.gltf import write_gltf
from langsplat_core.io.hostile import picture_size
from langsplat_core.io.scenes import load_scene
from langsplat_core.io.sidecar import read_language, write_language
from langsplat_core.progress import silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.semantics.features import FeatureStore, ImageFeatures
from tests.support.file_samples import (
    ascii_ply,
    compressed_ply,
    mixed_ply,
    plain_ply,
    random_field,
    sog_files,
    splat_bytes,
    spz_bytes,
    zipped,
)
from tests.support.mutation import FileKind, Mutation, in_gzip, in_ply_header, in_png, in_zip, mutant
from tests.support.photographs import write_colmap, write_nerfstudio
from tests.support.scenes import random_camera, random_gaussians

SCENE = random_gaussians(20, sh_degree=1)
PLAIN = random_gaussians(300, seed=1)


def gltf_bytes(gaussians: Gaussians, suffix: str = ".glb") -> bytes:
    """A scene as our writer makes it: the format's own writer is not in Python."""
    with TemporaryDirectory() as folder:
        write_gltf(Path(folder) / f"a{suffix}", gaussians)
        return (Path(folder) / f"a{suffix}").read_bytes()


def scene_share(path: Path) -> float:
    """Also makes what a viewer makes first: the camera that frames the scene, and what it sees."""
    scene = load_scene(path)
    drawn = render(scene, scene.framing_camera((32, 24)))
    assert np.isfinite(drawn.colours).all()
    assert np.isfinite(drawn.alpha).all()
    gaussians = scene.gaussians
    assert sum(gaussians.invalid_rows().values()) == len(gaussians) - gaussians.valid().sum()
    return drawable_share(gaussians)


def drawable_share(gaussians: Gaussians) -> float:
    return float(gaussians.valid().mean()) if len(gaussians) else 1.0


# -- samples -------------------------------------------------------------------------------------------------


def sidecars(folder: Path) -> list[bytes]:
    """Of every codec; version 2."""
    made = []
    for kind in ("codebook", "autoencoder", "linear"):
        write_language(folder / "made", random_field(len(SCENE), kind), SCENE.means)
        made.append((folder / "made").read_bytes())
    return made


def searched(path: Path) -> float:
    """Asks a field and draws the answer and what its latents look like: numbers that can be read may still be
    none to reckon with."""
    field = read_language(path, SCENE.means)
    vector = unit(np.random.default_rng(0).normal(size=field.codec.vector_dim)).astype(np.float32)
    scene = Scene(SCENE, replace(field, phrasebook={"cup": vector}))
    engine = QueryEngine(scene)
    answer = engine.run("cup")
    engine.instances(answer)
    values = np.concatenate([answer.relevancy.T, *latent_colours(field)], axis=1)
    drawn = render(scene, scene.framing_camera((32, 24)), values)
    assert np.isfinite(values).all()
    assert np.isfinite(drawn.values).all()
    return 1.0


def camera_files(folder: Path) -> list[bytes]:
    write_cameras(folder / "made", (random_camera(), random_camera(1)))
    return [(folder / "made").read_bytes()]


def camera_list(path: Path) -> float:
    for camera in read_cameras(path):
        assert np.isfinite([*camera.position, camera.intrinsics.fov_degrees]).all()
    return 1.0


def feature_files(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    store = FeatureStore(folder)
    for seed, count in enumerate((5, 1)):
        vectors = unit(rng.normal(size=(count, 8))).astype(np.float32)
        labels = rng.integers(-1, count, (3, 12, 16)).astype(np.int32)
        store.save(f"made{seed}", ImageFeatures(labels, vectors), "k" * seed)
    return [store.path(f"made{seed}").read_bytes() for seed in range(2)]


def stored_features(path: Path) -> float:
    store = FeatureStore(path.parent)
    there = store.has("a")
    if not there:  # which was said, and is not an error: they are made again
        return 0.0
    store.load("a")
    return 1.0


def transforms(folder: Path) -> list[bytes]:
    coefficients = {"k1": 0.01, "k2": 0.001, "p1": 1e-4}
    lenses = [
        {"fl_x": 50.0, "fl_y": 51.0, "cx": 20, "cy": 15, "w": 40, "h": 30, **coefficients},
        {"camera_angle_x": 0.8, "camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k4": 0.0},
        {"fl_x": 50, "metres_per_unit": 0.5, "applied_transform": np.eye(4)[:3].tolist()},
    ]
    made = []
    for lens in lenses:
        write_nerfstudio(folder, **lens, ply_file_path="cloud.ply")
        made.append((folder / "transforms.json").read_bytes())
    (folder / "cloud.ply").write_bytes(clouds(folder)[0])
    return made


def clouds(_: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    axes = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    made = []
    for colour in ("u1", "<f4", "<i4"):
        table = np.zeros(12, [*axes, *((name, colour) for name in ("red", "green", "blue"))])
        for name in table.dtype.names or ():
            table[name] = rng.uniform(0, 1 if colour == "<f4" else 200, 12)
        kinds = {"u1": "uchar", "<f4": "float", "<i4": "int"}
        header = ["ply", "format binary_little_endian 1.0", "element vertex 12"]
        header += [f"property float {name}" for name in "xyz"]
        header += [f"property {kinds[colour]} {name}" for name in ("red", "green", "blue")]
        made.append("\n".join([*header, "end_header\n"]).encode() + table.tobytes())
        header[1] = "format ascii 1.0"
        rows = [" ".join(str(value) for value in row) for row in table.tolist()]
        made.append("\n".join([*header, "end_header", *rows]).encode() + b"\n")
    return made


def cloud_folder(folder: Path) -> list[bytes]:
    write_nerfstudio(folder, ply_file_path="cloud.ply")
    return clouds(folder)


def beside_transforms(path: Path) -> float:
    return _usable(load_nerfstudio(path.parent / "transforms.json", 64, silent))


def _usable(capture: Capture) -> float:
    """All that training asks of a capture without looking at pixels; lost points were told of."""
    assert np.isfinite(capture.points).all()
    assert np.isfinite(capture.extent())
    assert all(np.isfinite(camera.position).all() for camera in capture.cameras)
    return 1.0


def colmap(part: str) -> FileKind:
    """`part`: cameras.bin, for one."""

    def samples(folder: Path) -> list[bytes]:
        return [(write_colmap(folder, part.rpartition(".")[2]) / part).read_bytes()]

    def read(path: Path) -> float:
        return _usable(load_colmap(path.parent.parent.parent, path.parent, 64, silent))

    return FileKind(f"sparse/0/{part}", samples, read)


def pictures(kind: str) -> Callable[[Path], list[bytes]]:
    """Of every mode that the kind has, with EXIF data."""

    def samples(_: Path) -> list[bytes]:
        rng = np.random.default_rng(0)
        noise = Image.fromarray(rng.integers(0, 256, (15, 20, 3), dtype=np.uint8)).resize((20, 15))
        exif = Image.Exif()
        exif.update({0x0112: 6, 0x010F: "maker", 0x0110: "model"})
        exif.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 28})
        deep = Image.fromarray(np.asarray(noise.convert("L")).astype(np.uint16) * 257)
        modes: dict[str, list[tuple[Image.Image, dict[str, object]]]] = {
            "PNG": [(noise.convert(mode), {}) for mode in ("RGB", "RGBA", "P", "L", "LA", "1")]
            + [(deep, {}), (noise, {"save_all": True, "append_images": [noise.convert("RGB")]})],
            "JPEG": [(noise, {}), (noise, {"progressive": True})]
            + [(noise.convert(mode), {}) for mode in ("L", "CMYK")],
            "WEBP": [(noise, {}), (noise, {"lossless": True}), (noise.convert("RGBA"), {"lossless": True})]
            + [(noise, {"save_all": True, "append_images": [noise.rotate(90)]})],
            "TIFF": [
                (noise, {"compression": way})
                for way in (None, "tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg")
            ]
            + [(deep, {}), (noise.convert("1"), {"compression": "group4"}), (noise.convert("CMYK"), {})]
            + [(noise.convert("P"), {})],
            "BMP": [(noise.convert(mode), {}) for mode in ("RGB", "P", "L", "1", "RGBA")],
            "AVIF": [(noise, {"speed": 10}), (noise.convert("RGBA"), {"speed": 10})],
        }
        made = []
        for picture, options in modes[kind]:
            buffer = io.BytesIO()
            picture.save(buffer, kind, **({} if kind == "BMP" else {"exif": exif}), **options)
            made.append(buffer.getvalue())
        return made

    return samples


def photograph(path: Path) -> float:
    width, height = picture_size(path)
    for upright in (False, True):
        picture = read_photo(path, upright)
        assert picture.mode == "RGB"
        assert {*picture.size} == {width, height}
    return 1.0


def _photographs(kind: str, damage: Mutation = mutant) -> FileKind:
    return FileKind("a.png", pictures(kind), photograph, damage)  # the name's ending plays no part


def _scenes(file: str, *samples: bytes, damage: Mutation = mutant) -> FileKind:
    return FileKind(file, lambda _: [*samples], scene_share, damage)


KINDS = {
    "INRIA PLY": _scenes(
        *("a.ply", plain_ply(SCENE), plain_ply(PLAIN), mixed_ply(SCENE), ascii_ply(random_gaussians(5))),
        damage=in_ply_header,
    ),
    "compressed PLY": _scenes(
        "a.ply", compressed_ply(SCENE), compressed_ply(PLAIN, colours=False), damage=in_ply_header
    ),
    "SOG": _scenes("a.sog", zipped(sog_files(SCENE)), zipped(sog_files(PLAIN)), damage=in_zip),
    **{
        f"SPZ {v}": _scenes("a.spz", spz_bytes(SCENE, v), spz_bytes(PLAIN, v), damage=in_gzip)
        for v in (1, 2, 3, 4)
    },
    ".glb": _scenes("a.glb", gltf_bytes(SCENE), gltf_bytes(PLAIN)),
    ".gltf": _scenes("a.gltf", gltf_bytes(random_gaussians(3), ".gltf")),
    ".splat": _scenes("a.splat", splat_bytes(SCENE), splat_bytes(PLAIN)),
    "sidecar": FileKind("a.langsplat.safetensors", sidecars, searched),
    "cameras.json": FileKind("a.cameras.json", camera_files, camera_list),
    "transforms.json": FileKind("transforms.json", transforms, beside_transforms),
    "point-cloud PLY": FileKind("cloud.ply", cloud_folder, beside_transforms, in_ply_header),
    **{
        f"COLMAP {part}.{form}": colmap(f"{part}.{form}")
        for form in ("bin", "txt")
        for part in ("cameras", "images", "points3D")
    },
    ".features.npz": FileKind("a.features.npz", feature_files, stored_features, in_zip),
    "PNG": _photographs("PNG", in_png),
    **{kind: _photographs(kind) for kind in ("JPEG", "WEBP", "TIFF", "BMP", "AVIF")},
}
# In which a byte that is missing cannot go unseen, nor can another format's file be taken for one.
STRICT = ["INRIA PLY", "compressed PLY", "SOG", "SPZ 3", "SPZ 4", ".splat"]
STRICT += ["sidecar", "cameras.json"]
