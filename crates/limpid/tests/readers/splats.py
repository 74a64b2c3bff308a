"""Gaussians from files, by readers of others, in one form; and a renderer of them that shares no line with Limpid's.

A scene is a dict: means [N, 3], rotations [N, 3, 3], scales [N, 3], opacities [N], sh [N, K, 3], with y down and z forward.
"""


import numpy as np

# glTF's axes: y up, x left, z forward.
GLTF = np.diag([-1.0, -1.0, 1.0])
# Powers of the spherical harmonics, in the order of 3DGS.
POWERS = ["", "y", "z", "x", "xy", "yz", "zz", "xz", "xx", "xxy", "xyz", "yzz", "zzz", "xzz", "xxz", "xxx"]
GLTF_SIGNS = np.array([np.prod([GLTF["xyz".index(c), "xyz".index(c)] for c in p]) for p in POWERS])


def rotation_matrices(quats):
    """Of quaternions (w, x, y, z) of any length."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turned(scene):
    """From glTF's axes to ours or back."""
    count = scene["sh"].shape[1]
    return {
        **scene,
        "means": scene["means"] @ GLTF,
        "rotations": GLTF @ scene["rotations"],
        "sh": scene["sh"] * GLTF_SIGNS[:count, None],
    }


def from_ply(path):
    from plyfile import PlyData

    vertex = PlyData.read(path)["vertex"]
    column = lambda *names: np.stack([np.asarray(vertex[n], np.float64) for n in names], 1)
    rest = sum(p.name.startswith("f_rest_") for p in vertex.properties)
    dc = column("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    more = np.zeros((len(dc), 0, 3))
    if rest:
        # Channel-major in the file.
        more = column(*(f"f_rest_{i}" for i in range(rest))).reshape(len(dc), 3, -1).swapaxes(1, 2)
    return {
        "means": column("x", "y", "z"),
        "rotations": rotation_matrices(column("rot_0", "rot_1", "rot_2", "rot_3")),
        "scales": np.exp(column("scale_0", "scale_1", "scale_2")),
        "opacities": 1 / (1 + np.exp(-np.asarray(vertex["opacity"], np.float64))),
        "sh": np.concatenate([dc, more], 1),
    }


class Glb:
    """A glTF file with KHR_gaussian_splatting, by pygltflib."""

    def __init__(self, path):
        from pygltflib import GLTF2

        self.gltf = GLTF2().load(path)
        assert "KHR_gaussian_splatting" in self.gltf.extensionsUsed
        self.blob = self.gltf.binary_blob()

    def accessor(self, index):
        a = self.gltf.accessors[index]
        view = self.gltf.bufferViews[a.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[a.type]
        kind = {5126: np.float32, 5121: np.uint8}[a.componentType]
        start = (view.byteOffset or 0) + (a.byteOffset or 0)
        return np.frombuffer(self.blob, kind, a.count * width, start).reshape(a.count, width).astype(np.float64)

    def seconds(self):
        return self.accessor(self.gltf.animations[0].samplers[0].input)[:, 0]

    def parts(self, moment=None):
        """Each node's Gaussians in the world (y up), and its own positions; at one of the animation's moments, if it has any."""
        for index in self.gltf.scenes[self.gltf.scene].nodes:
            node = self.gltf.nodes[index]
            (primitive,) = self.gltf.meshes[node.mesh].primitives
            assert primitive.mode == 0
            extension = primitive.extensions["KHR_gaussian_splatting"]
            assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"
            attributes = vars(primitive.attributes)
            own = lambda name: self.accessor(attributes["KHR_gaussian_splatting:" + name])
            coefficients = [(l, m) for l in range(4) for m in range(2 * l + 1)]
            named = [f"SH_DEGREE_{l}_COEF_{m}" for l, m in coefficients]
            named = [n for n in named if "KHR_gaussian_splatting:" + n in attributes]
            pose = self.pose(index, node, moment)
            x, y, z, w = own("ROTATION").T
            local = self.accessor(primitive.attributes.POSITION)
            scene = {
                "means": local @ pose[:3, :3].T + pose[:3, 3],
                "rotations": pose[:3, :3] @ rotation_matrices(np.stack([w, x, y, z], 1)),
                "scales": own("SCALE"),
                "opacities": own("OPACITY")[:, 0],
                # Readers may turn them with the node; Limpid's stay with the world.
                "sh": np.stack([own(n) for n in named], 1),
            }
            yield node.name, local, scene

    def pose(self, index, node, moment):
        rotation, translation = node.rotation or [0, 0, 0, 1], node.translation or [0, 0, 0]
        if moment is not None:
            for animation in self.gltf.animations:
                for channel in (c for c in animation.channels if c.target.node == index):
                    value = self.accessor(animation.samplers[channel.sampler].output)[moment]
                    if channel.target.path == "rotation":
                        rotation = value
                    else:
                        translation = value
        x, y, z, w = rotation
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrices(np.array([[w, x, y, z]]))[0]
        pose[:3, 3] = translation
        return pose

    def scene(self, moment=None):
        parts = [scene for _, _, scene in self.parts(moment)]
        return turned({key: np.concatenate([part[key] for part in parts]) for key in parts[0]})


def colors(scene, center):
    """Of all Gaussians seen from a point, by the formulas of KHR_gaussian_splatting."""
    d = scene["means"] - center
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T
    basis = [
        0.2820947917738781 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.092548430592079 * x * y,
        -1.092548430592079 * y * z,
        0.31539156525252 * (2 * z * z - x * x - y * y),
        -1.092548430592079 * x * z,
        0.5462742152960395 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644657 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644657 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    basis = np.stack(basis[: scene["sh"].shape[1]], 1)
    return np.maximum(np.einsum("nk,nkc->nc", basis, scene["sh"]) + 0.5, 0)


def render(scene, camera, cam_from_world, near=1e-2):
    """The picture [H, W, 3]: 3DGS's projection, low-pass 0.3 px², alpha from 1/255 to 0.999, nearest first."""
    w, h, fx, fy, cx, cy = camera
    w, h = int(w), int(h)
    turn, shift = cam_from_world[:3, :3], cam_from_world[:3, 3]
    p = scene["means"] @ turn.T + shift
    rgb = colors(scene, -turn.T @ shift)
    shape = turn @ scene["rotations"] * scene["scales"][:, None, :]
    z = np.where(p[:, 2] > near, p[:, 2], 1)
    # The slope of far points is limited as in 3DGS: 15 % beyond the picture's edges.
    margin_x, margin_y = 0.3 * 0.5 * w / fx, 0.3 * 0.5 * h / fy
    tx = z * np.clip(p[:, 0] / z, -cx / fx - margin_x, (w - cx) / fx + margin_x)
    ty = z * np.clip(p[:, 1] / z, -cy / fy - margin_y, (h - cy) / fy + margin_y)
    jacobian = np.zeros((len(z), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = fx / z, -fx * tx / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = fy / z, -fy * ty / z**2
    half = jacobian @ shape
    cov = half @ half.swapaxes(1, 2) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(cov)
    at = np.stack([fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy], 1)
    # Where alpha falls under 1/255.
    reach = np.sqrt(2 * np.log(np.maximum(255 * scene["opacities"], 1))[:, None] * cov[:, [0, 1], [0, 1]])
    low = np.clip(np.floor(at - reach - 0.5), 0, [w, h]).astype(int)
    high = np.clip(np.ceil(at + reach + 0.5), 0, [w, h]).astype(int)
    drawn = (p[:, 2] > near) & (high > low).all(1) & (scene["opacities"] > 1 / 255)
    picture, through = np.zeros((h, w, 3)), np.ones((h, w))
    for i in np.flatnonzero(drawn)[np.argsort(p[drawn, 2], kind="stable")]:
        (x0, y0), (x1, y1) = low[i], high[i]
        dx = np.arange(x0, x1) + 0.5 - at[i, 0]
        dy = (np.arange(y0, y1) + 0.5 - at[i, 1])[:, None]
        a, b, c = inverse[i, 0, 0], inverse[i, 0, 1], inverse[i, 1, 1]
        power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = np.minimum(scene["opacities"][i] * np.exp(-power), 0.999)
        alpha[alpha < 1 / 255] = 0
        weight = alpha * through[y0:y1, x0:x1]
        picture[y0:y1, x0:x1] += weight[..., None] * rgb[i]
        through[y0:y1, x0:x1] *= 1 - alpha
    return picture


