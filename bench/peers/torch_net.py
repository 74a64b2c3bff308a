"""Extractor, BP-Net and blur in PyTorch, timed in turns with Limpid's own.

    cargo build -p limpid-bench
    python bench/peers/torch_net.py [--size 256x144] [--rounds 5] [--frozen]

Needs PyTorch (pip install torch) in an environment outside the repository. The network is the same: 5x5 and 5x5
convolutions of 64 channels with ReLU and instance norm, a 3x3 one of 32; four 1x1 layers with the features joined to the
first two; softmax over K * K; a kernel for every pixel through `unfold`; forward and backward in f32 on all cores.
Prints medians of all passes in ms, and PyTorch's rate for a large matrix product.
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import time

import torch
import torch.nn.functional as F
from torch import nn

ROOT = pathlib.Path(__file__).resolve().parents[2]


class Net(nn.Module):
    """What bpnet::BpNet computes, in PyTorch's own operations."""

    def __init__(self, kernel_size, frozen):
        super().__init__()
        self.kernel_size = kernel_size
        self.extractor = nn.ModuleList(
            [nn.Conv2d(5, 64, 5, padding=2), nn.Conv2d(64, 64, 5, padding=2), nn.Conv2d(64, 32, 3, padding=1)]
        )
        self.extractor.requires_grad_(not frozen)
        self.embedding = nn.Parameter(torch.randn(24, 32))
        self.base = nn.ModuleList([nn.Conv2d(80, 64, 1), nn.Conv2d(96, 64, 1), nn.Conv2d(96, 64, 1)])
        self.kernel_head = nn.Conv2d(64, kernel_size * kernel_size, 1)
        self.intensity_head = nn.Conv2d(64, 1, 1)

    def forward(self, scene, encoding, image):
        first, second, third = self.extractor
        x = F.instance_norm(F.relu(first(scene)))
        x = F.instance_norm(F.relu(second(x)))
        features = third(x)
        height, width = scene.shape[2:]
        embedding = self.embedding[1].view(1, -1, 1, 1).expand(1, -1, height, width)
        hidden = F.relu(self.base[0](torch.cat([embedding, encoding, features], 1)))
        for layer in self.base[1:]:
            hidden = F.relu(layer(torch.cat([hidden, features], 1)))
        kernel = F.softmax(self.kernel_head(hidden), 1)
        m = torch.sigmoid(self.intensity_head(hidden))
        k = self.kernel_size
        windows = F.unfold(image, k, padding=k // 2).view(1, 3, k * k, height, width)
        inside = F.unfold(torch.ones_like(image[:, :1]), k, padding=k // 2).view(1, k * k, height, width)
        weights = kernel * inside
        blurred = (windows * weights.unsqueeze(1)).sum(2) / weights.sum(1, keepdim=True)
        return image + m * (blurred - image)


def waits_for(device):
    """What returns once a device has done all that it was asked for."""
    return torch.cuda.synchronize if torch.device(device).type == "cuda" else lambda: None


def torch_passes(net, width, height, repeats, device="cpu"):
    wait = waits_for(device)
    scene, encoding = (torch.rand(1, channels, height, width, device=device) for channels in (5, 16))
    times = []
    for _ in range(repeats + 2):
        image = torch.rand(1, 3, height, width, device=device, requires_grad=True)
        net.zero_grad()
        wait()
        start = time.perf_counter()
        net(scene, encoding, image).sum().backward()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    return times[2:]


def limpid_passes(width, height, repeats, frozen):
    target = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    command = [target / "debug" / "limpid-bench", "net", "--width", width, "--height", height, "--repeats", repeats]
    command += ["--frozen"] if frozen else []
    output = subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True)
    return json.loads(output.stdout)["median_ms"]


def product_rate(size=2048):
    a, b = torch.rand(size, size), torch.rand(size, size)
    best = 1e9
    for _ in range(8):
        start = time.perf_counter()
        a @ b
        best = min(best, time.perf_counter() - start)
    return 2 * size**3 / best * 1e-9


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="256x144")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frozen", action="store_true")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    torch.manual_seed(1)
    net = Net(9, args.frozen)
    theirs, ours = [], []
    for _ in range(args.rounds):
        theirs += torch_passes(net, width, height, 4)
        ours.append(limpid_passes(width, height, 6, args.frozen))
    theirs, ours = statistics.median(theirs), statistics.median(ours)
    print(f"PyTorch {torch.__version__}, {torch.get_num_threads()} threads, 2048³ product {product_rate():.0f} GFLOP/s")
    what = "frozen" if args.frozen else "trained"
    print(f"{args.size}, extractor {what}: PyTorch {theirs:.1f} ms, Limpid {ours:.1f} ms, {theirs / ours:.2f} times")


if __name__ == "__main__":
    main()
