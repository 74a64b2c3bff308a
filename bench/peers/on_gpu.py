"""gsplat's rasteriser and BP-Net in PyTorch on a GPU, at the sizes that Limpid was timed at there.

    cargo xtask bench --backend wgpu                # or cuda: writes out/bench/gpu.json
    python bench/peers/on_gpu.py [out/bench/gpu.json]

Needs PyTorch for the GPU and gsplat (pip install torch gsplat ninja packaging) in an environment outside the repository, and
CUDA's compiler for gsplat's kernels. The Gaussians are drawn as Limpid's benchmark draws them (z even in [2, 8], x and y even over
1.1 times the view, 1.3 px large, spherical harmonics of degree 3), and colour, alpha and depth are rendered and go back in f32, as
there. Writes `peers.json` beside the file that it reads, and prints a table with how many times as long each peer takes.

On a machine without a GPU, `--device cpu` times the network alone: gsplat has no kernels for a CPU.
"""

import argparse
import json
import math
import pathlib
import re
import statistics
import time

import torch

from torch_net import Net, torch_passes, waits_for

REPEATS = 40
FOCAL = 30 / 36  # of the width
RASTERISED = re.compile(r"forward( and backward)?, (\d+)x(\d+), (\d+) Gaussians")
NETWORK = re.compile(r"BP-Net and back, (\d+)x(\d+), ")


def gaussians(count, width, height, device):
    """Means, quaternions, scales, opacities and coefficients of SH, as bench/src/workload.rs draws them."""
    torch.manual_seed(1)
    z = 2.0 + 6.0 * torch.rand(count)
    place = (torch.rand(count, 2) - 0.5) * 1.1 * torch.tensor([width, height]) * z[:, None] / (FOCAL * width)
    size = 1.3 * z / (FOCAL * width) * torch.exp(0.4 * torch.randn(count))
    scales = size[:, None] * torch.exp(0.3 * torch.randn(count, 3))
    strength = torch.tensor([0.5] + [0.05] * 15)[:, None]
    tables = [
        torch.cat([place, z[:, None]], 1),
        torch.randn(count, 4),
        scales,
        torch.sigmoid(2.0 * torch.randn(count)),
        strength * torch.randn(count, 16, 3),
    ]
    return [table.to(device).requires_grad_() for table in tables]


def rasterise(count, width, height, back, device, repeats):
    """gsplat, forward with all that its way back needs, or both ways."""
    from gsplat import rasterization

    tables = gaussians(count, width, height, device)
    pose = torch.eye(4, device=device)[None]
    focal = FOCAL * width
    lens = torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]], device=device)

    wait, times = waits_for(device), []
    for _ in range(repeats + 2):
        for table in tables:
            table.grad = None
        wait()
        start = time.perf_counter()
        picture, alpha, _ = rasterization(
            *tables, pose, lens, width, height, sh_degree=3, render_mode="RGB+D", packed=False
        )
        if back:
            (picture.sum() + alpha.sum()).backward()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[2:])


def network(width, height, device, repeats):
    """Extractor, BP-Net and blur with K = 9, forward and back."""
    torch.manual_seed(1)
    net = Net(9, False).to(device)
    return statistics.median(torch_passes(net, width, height, repeats, device))


def peer(name, device, repeats):
    """The peer of one of Limpid's parts and its time, `None` for a part that has none; a text is why it was not timed."""
    if found := RASTERISED.fullmatch(name):
        back, *size = found.groups()
        width, height, count = map(int, size)
        call = lambda: rasterise(count, width, height, back is not None, device, repeats)
        who = "gsplat"
    elif found := NETWORK.match(name):
        width, height = map(int, found.groups())
        call = lambda: network(width, height, device, repeats)
        who = "PyTorch"
    else:
        return None
    try:
        return who, call()
    except Exception as problem:  # Whatever one peer refuses, the others are timed.
        return who, f"{type(problem).__name__}: {problem}".splitlines()[0]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("gpu", nargs="?", default="out/bench/gpu.json", type=pathlib.Path)
    parser.add_argument("--device", default="cuda", choices=["cuda", "cpu"])
    parser.add_argument("--repeats", type=int, default=REPEATS)
    args = parser.parse_args()
    device = torch.device(args.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.exit(1, "PyTorch finds no GPU; --device cpu times the network alone\n")
    where = torch.cuda.get_device_name() if device.type == "cuda" else "the CPU"
    rows = []
    print(f"PyTorch {torch.__version__} on {where}\n\n| | peer | ms | Limpid, ms | times as long |\n|---|---|---|---|---|")
    for part in json.loads(args.gpu.read_text())["parts"]:
        found = peer(part["name"], device, args.repeats)
        if found is None:
            continue
        who, theirs = found
        ours = part["outcome"].get("timed", {}).get("median_ms", math.nan)
        if isinstance(theirs, str):
            rows.append({"name": part["name"], "peer": who, "refused": theirs})
            print(f"| {part['name']} | {who} | {theirs} | {ours:.2f} | |", flush=True)
        else:
            rows.append({"name": part["name"], "peer": who, "median_ms": theirs, "times_as_long": theirs / ours})
            print(f"| {part['name']} | {who} | {theirs:.2f} | {ours:.2f} | {theirs / ours:.2f} |", flush=True)
    result = {"torch": torch.__version__, "device": where, "repeats": args.repeats, "parts": rows}
    args.gpu.with_name("peers.json").write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
