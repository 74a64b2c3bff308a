"""Reads what `limpid export` wrote with other people's readers, and compares numbers and pixels.

    python read_exports.py EXPORT FRAME [NODE_MODULES]

EXPORT holds `--format canonical,ply,ply-sequence,spz,transforms,colmap,glb --at FRAME` and, where the bases allow, `--format glb`
as scene.glb. Needs numpy, plyfile and pillow; with pygltflib, pycolmap, and splat-transform and gltf-validator in NODE_MODULES
it reads more, and with viewers there and Chromium (`chromium`, or LIMPID_CHROMIUM) it looks (view_exports.mjs). It says what it left
out ("skipped: …"). Fails with an AssertionError at the first thing that is not as it should be.
"""

import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import version

import numpy as np
from PIL import Image

import splats

FOLDER, FRAME = sys.argv[1], int(sys.argv[2])
NODE_MODULES = os.path.abspath(sys.argv[3]) if len(sys.argv) > 3 and sys.argv[3] else ""


def path(*parts):
    return os.path.join(FOLDER, *parts)


def has(module):
    try:
        __import__(module)
        return True
    except ImportError:
        print(f"skipped: exports by {module}: it is not installed")
        return False


def node(name, *arguments):
    """Runs a tool of npm's; None where it is not installed."""
    tool = os.path.join(NODE_MODULES, ".bin", name)
    if not NODE_MODULES or not os.path.exists(tool):
        print(f"skipped: exports by {name}: it is not installed")
        return None
    run = subprocess.run([tool, *arguments], capture_output=True, text=True, check=True)
    return run.stdout + run.stderr


def worst(a, b):
    return float(np.abs(a - b).max()) if a.size else 0.0


def compare(name, found, expected, limits):
    """All numbers; rotations as covariances over the largest scale's square, for an axis may point either way."""
    assert len(found["means"]) == len(expected["means"]), f"{name}: {len(found['means'])} Gaussians"
    shape = lambda s: s["rotations"] * s["scales"][:, None] / s["scales"].max(1)[:, None, None]
    cov = lambda s: shape(s) @ shape(s).swapaxes(1, 2)
    off = {
        "means": worst(found["means"], expected["means"]),
        "scales": worst(np.log(found["scales"]), np.log(expected["scales"])),
        "shapes": worst(cov(found), cov(expected)),
        "opacities": worst(found["opacities"], expected["opacities"]),
        "base colours": worst(found["sh"][:, 0], expected["sh"][:, 0]),
        "other colours": worst(found["sh"][:, 1:], np.clip(expected["sh"][:, 1:], -limits.get("clip", 1e9), limits.get("clip", 1e9))),
    }
    print(f"{name}: " + ", ".join(f"{key} {value:.2g}" for key, value in off.items()))
    for key, value in off.items():
        assert value <= limits[key], f"{name}: {key} are off by {value}"


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-12))


transforms = json.load(open(path("transforms", "transforms.json")))
frames = [f for f in transforms["frames"] if f["split"] == "train"]
frame = frames[FRAME]
camera = [frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")]
cam_from_world = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
truth = np.asarray(Image.open(path("transforms", frame["file_path"])), np.float64) / 255


def look(name, scene, least):
    """The independent renderer's picture against Limpid's own, from the exported camera."""
    picture = np.clip(splats.render(scene, camera, cam_from_world), 0, 1)
    found = psnr(np.round(255 * picture) / 255, truth)
    mean = 255 * np.abs(picture - truth).mean()
    print(f"{name}: drawn by numpy, {found:.1f} dB and {mean:.2f}/255 on average from Limpid's own picture")
    assert found >= least, name


# PLY.
still = splats.from_ply(path(f"scene_at_{FRAME}.ply"))
exact = dict.fromkeys(["means", "scales", "shapes", "opacities", "base colours", "other colours"], 1e-5)
names = sorted(os.listdir(path("ply")))
assert names == [f"frame_{i:04}.ply" for i in range(len(frames))], names
print(f"plyfile {version('plyfile')}: {len(names)} numbered files")
compare("frame of the sequence against the moment", splats.from_ply(path("ply", names[FRAME])), still, exact)
look("PLY", still, 40)
canonical = splats.from_ply(path("canonical.ply"))
assert len(canonical["means"]) == len(still["means"])

# Cameras.
if has("pycolmap"):
    import pycolmap

    model = pycolmap.Reconstruction(path("colmap", "sparse", "0"))
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    assert len(images) == len(transforms["frames"]) and len(model.points3D) > 0
    off = 0.0
    for image, entry in zip(images, transforms["frames"]):
        assert image.name == entry["file_path"].removeprefix("images/"), image.name
        assert os.path.exists(path("colmap", "images", image.name))
        lens = model.cameras[image.camera_id]
        assert lens.model.name == "PINHOLE"
        assert np.allclose(lens.params, [entry[k] for k in ("fl_x", "fl_y", "cx", "cy")], rtol=1e-12)
        assert (lens.width, lens.height) == (entry["w"], entry["h"])
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        gl = np.linalg.inv(np.array(entry["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        off = max(off, worst(pose.matrix(), gl[:3]))
    print(f"pycolmap {version('pycolmap')}: {len(images)} cameras, off by {off:.1g} from transforms.json; {len(model.points3D)} points")
    assert off < 1e-9
    # Points are seen where they are: in most pictures' fields of view.
    points = np.array([p.xyz for p in model.points3D.values()])
    ahead = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    assert (ahead[:, 2] > 0).mean() > 0.5

# glTF.
if has("pygltflib"):
    glb = splats.Glb(path(f"scene_at_{FRAME}.glb")).scene()
    compare(f"pygltflib {version('pygltflib')}", glb, still, exact)
    look("glTF", glb, 40)
    if os.path.exists(path("scene.glb")):
        moving = splats.Glb(path("scene.glb"))
        seconds = moving.seconds()
        assert len(seconds) == len(frames) and seconds[0] == 0
        rows = {tuple(p): i for i, p in enumerate((canonical["means"] @ splats.GLTF).astype(np.float32).tolist())}
        most = 0.0
        for moment, name in enumerate(names):
            there = splats.from_ply(path("ply", name))["means"] @ splats.GLTF
            seen = 0
            for part, local, scene in moving.parts(moment):
                at = [rows[tuple(p)] for p in local.astype(np.float32).tolist()]
                off = np.linalg.norm(scene["means"] - there[at], axis=1)
                assert part != "static" or off.max() < 1e-5
                most, seen = max(most, off.max()), seen + len(at)
            assert seen == len(there)
        print(f"glTF's animation: {len(seconds)} moments, Gaussians up to {most:.3g} scene units from the sequence's")
        look("glTF's animation", moving.scene(FRAME), 0)
validator = os.path.join(NODE_MODULES, "gltf-validator") if NODE_MODULES else ""
if os.path.exists(validator):
    script = (
        "const v = require(process.argv[1]), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(r => console.log(JSON.stringify(r)))"
    )
    for name in (f"scene_at_{FRAME}.glb", "scene.glb"):
        if os.path.exists(path(name)):
            run = subprocess.run(["node", "-e", script, validator, path(name)], capture_output=True, text=True, check=True)
            report = json.loads(run.stdout)
            messages = report["issues"]["messages"]
            # It is older than the extension, and takes its attributes' names for wrong ones.
            errors = [m for m in messages if m["severity"] == 0 and "KHR_gaussian_splatting:" not in m["pointer"]]
            warnings = [m for m in messages if m["severity"] == 1]
            print(f"glTF validator {report['validatorVersion']}: {name}: {len(errors)} errors, {len(warnings)} warnings beside the extension's own")
            assert not errors and not warnings, (errors + warnings)[:3]
else:
    print("skipped: exports by gltf-validator: it is not installed")

# SPZ, and PLY once more.
told = node("splat-transform", "--version")
if told is not None:
    tool = next(line for line in told.splitlines() if "splat-transform v" in line)
    node("splat-transform", "-w", "-g", "cpu", path(f"scene_at_{FRAME}.spz"), path("by_splat_transform.ply"))
    spz = splats.from_ply(path("by_splat_transform.ply"))
    limits = {"means": 1e-4, "scales": 0.04, "shapes": 0.14, "opacities": 0.003, "base colours": 0.014, "other colours": 0.004, "clip": 1.0}
    compare(f"{tool}: SPZ", spz, still, limits)
    look("SPZ", spz, 40)
    node("splat-transform", "-w", "-g", "cpu", path("ply", names[FRAME]), path("again.ply"))
    compare(f"{tool}: PLY", splats.from_ply(path("again.ply")), still, exact)
    node("splat-transform", "-w", "-g", "cpu", path("ply", names[FRAME]), path("theirs.glb"))
    if has("pygltflib"):
        theirs = splats.Glb(path("theirs.glb"))
        compare(f"{tool}: its own glTF of our PLY", theirs.scene(), still, exact)

# Viewers.
chromium = os.environ.get("LIMPID_CHROMIUM") or shutil.which("chromium")
if NODE_MODULES and chromium:
    script = os.path.join(os.path.dirname(os.path.abspath(__file__)), "view_exports.mjs")
    run = subprocess.run(["node", script, FOLDER, str(FRAME), NODE_MODULES, chromium], capture_output=True, text=True)
    print(run.stdout, end="")
    assert run.returncode == 0, run.stdout + run.stderr
else:
    print(f"skipped: exports in viewers: {'Chromium' if NODE_MODULES else 'node_modules'} is not there")
print("exports: all as they should be")
