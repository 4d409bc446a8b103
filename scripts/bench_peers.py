#!/usr/bin/env python3
"""What a frame costs elsewhere: PyTorch running ToMP in its plain form, OpenCV's NanoTrack v2.

    scripts/bench_peers.py [--presets tomp101,tomp50] [--peers DIR] [--threads N] [--frames N]
                           [--tsda target/release/tsda --bundles X.tsda,..] [--json FILE]

PyTorch: the network of the paper (Mayer et al. 2022) as it is usually written: batch norms unfolded,
both boxes of the box branch as a batch of two with a key mask, full cross-attention, two templates
encoded anew in every frame. Random weights; a frame's cost does not depend on them. NanoTrack: the two
ONNX files of NanoTrack v2 in DIR (`nanotrack_v2_backbone_255.onnx`, `nanotrack_v2_head.onnx`; without
--peers ../shared/data/peers beside the checkout). With --tsda the program itself is measured in the
same run, for ratios. What is missing is said and left out:

    pip install torch opencv-python-headless numpy

Exit codes: 0 something was measured, 1 nothing was, 2 wrong arguments.
"""
import argparse
import json
import math
import os
import pathlib
import subprocess
import sys
import time

ROOT = pathlib.Path(__file__).resolve().parent.parent
BLOCKS = {"tomp50": (3, 4, 6), "tomp101": (3, 4, 23)}
SIDE, MAP, WIDTH, HEADS, FF, LAYERS, TEMPLATES = 288, 18, 256, 8, 2048, 6, 2


def measure(call, frames):
    """Median and 95th percentile by the clock, median of processor time, in milliseconds."""
    for _ in range(3):
        call()
    wall, cpu = [], []
    for _ in range(frames):
        w, c = time.perf_counter(), time.process_time()
        call()
        wall.append(1e3 * (time.perf_counter() - w))
        cpu.append(1e3 * (time.process_time() - c))
    wall.sort()
    cpu.sort()
    rank = lambda values, share: values[max(math.ceil(share * len(values)) - 1, 0)]
    return {"cpu_ms_p50": rank(cpu, 0.5), "wall_ms_p50": rank(wall, 0.5), "p95": rank(wall, 0.95)}


def plain_tomp(preset):
    """A closure that does the network's work of one frame."""
    import torch
    from torch import nn

    class Bottleneck(nn.Module):
        def __init__(self, inner, outer, stride, project):
            super().__init__()
            conv = lambda i, o, k, s: nn.Sequential(
                nn.Conv2d(i, o, k, s, k // 2, bias=False), nn.BatchNorm2d(o))
            relu = nn.ReLU(inplace=True)
            self.body = nn.Sequential(conv(outer[0], inner, 1, 1), relu, conv(inner, inner, 3, stride),
                                      relu, conv(inner, outer[1], 1, 1))
            self.skip = conv(outer[0], outer[1], 1, stride) if project else nn.Identity()

        def forward(self, x):
            return torch.relu(self.body(x) + self.skip(x))

    def backbone():
        layers = [nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64), nn.ReLU(),
                  nn.MaxPool2d(3, 2, 1)]
        channels = 64
        for stage, count in enumerate(BLOCKS[preset]):
            inner = 64 << stage
            for block in range(count):
                stride = 2 if stage > 0 and block == 0 else 1
                layers.append(Bottleneck(inner, (channels, 4 * inner), stride, block == 0))
                channels = 4 * inner
        return nn.Sequential(*layers, nn.Conv2d(channels, WIDTH, 3, 1, 1, bias=False))

    def feed_forward():
        return nn.Sequential(nn.Linear(WIDTH, FF), nn.ReLU(), nn.Linear(FF, WIDTH))

    class Layer(nn.Module):
        """Of the encoder, or with `cross` of the decoder; normalised after each part."""

        def __init__(self, cross):
            super().__init__()
            attend = lambda: nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)
            self.inner, self.cross = attend(), attend() if cross else None
            self.ff = feed_forward()
            self.norms = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(3 if cross else 2))

        def forward(self, x, pos, mask, memory=None, memory_pos=None):
            own = None if self.cross else mask
            q = x + pos
            x = self.norms[0](x + self.inner(q, q, x, own, need_weights=False)[0])
            if self.cross:
                key = memory + memory_pos
                found = self.cross(x + pos, key, memory, mask, need_weights=False)[0]
                x = self.norms[1](x + found)
            return self.norms[-1](x + self.ff(x))

    class Net(nn.Module):
        def __init__(self):
            super().__init__()
            self.backbone = backbone()
            self.boxes = nn.Sequential(nn.Conv1d(4, 64, 1), nn.BatchNorm1d(64), nn.ReLU(),
                                       nn.Conv1d(64, WIDTH, 1), nn.BatchNorm1d(WIDTH), nn.ReLU(),
                                       nn.Conv1d(WIDTH, WIDTH, 1))
            self.encoder = nn.ModuleList(Layer(False) for _ in range(LAYERS))
            self.decoder = nn.ModuleList(Layer(True) for _ in range(LAYERS))
            self.norm = nn.LayerNorm(WIDTH)
            self.query = nn.Parameter(torch.randn(1, 1, WIDTH))
            self.classify, self.regress = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)
            tower = []
            for _ in range(4):
                tower += [nn.Conv2d(WIDTH, WIDTH, 3, 1, 1), nn.GroupNorm(1, WIDTH), nn.ReLU()]
            self.tower = nn.Sequential(*tower, nn.Conv2d(WIDTH, 4, 3, 1, 1))

        def forward(self, crop, templates, label, ltrb, pos, mask):
            feature = self.backbone(crop)
            feature = feature * (feature[0].numel() / (feature.pow(2).sum() + 1e-5)).sqrt()
            coded = self.boxes(ltrb).view(TEMPLATES, WIDTH, MAP, MAP)
            foreground = self.query.view(1, WIDTH, 1, 1)
            tokens = torch.cat([templates + label * foreground + coded, feature])
            x = tokens.flatten(2).permute(0, 2, 1).reshape(1, -1, WIDTH).repeat(2, 1, 1)
            for layer in self.encoder:
                x = layer(x, pos, mask)
            t = torch.zeros(2, 1, WIDTH)
            for layer in self.decoder:
                t = layer(t, self.query, mask, x, pos)
            t = self.norm(t)
            search = x[:, -MAP * MAP:].transpose(1, 2).reshape(2, WIDTH, MAP, MAP)
            scores = torch.einsum("c,chw->hw", self.classify(t[0, 0]), search[0])
            weight = torch.einsum("c,chw->hw", self.regress(t[1, 0]), search[1])
            return scores, self.tower((weight * search[1])[None]).exp()

    torch.manual_seed(1)
    net = Net().eval()
    cells = MAP * MAP
    mask = torch.zeros(2, (TEMPLATES + 1) * cells, dtype=torch.bool)
    mask[1, cells:TEMPLATES * cells] = True
    inputs = (torch.randn(1, 3, SIDE, SIDE), torch.randn(TEMPLATES, WIDTH, MAP, MAP),
              torch.rand(TEMPLATES, 1, MAP, MAP), torch.rand(TEMPLATES, 4, cells),
              torch.randn(1, (TEMPLATES + 1) * cells, WIDTH), mask)

    def frame():
        with torch.inference_mode():
            net(*inputs)

    return frame


def run_torch(presets, threads, frames):
    try:
        import torch
    except ImportError as e:
        print(f"left out: PyTorch: {e}; pip install torch", file=sys.stderr)
        return
    torch.set_num_threads(threads)
    for preset in presets:
        yield f"torch {torch.__version__} {preset}", measure(plain_tomp(preset), frames)


def run_nanotrack(folder, threads, frames):
    names = ["nanotrack_v2_backbone_255.onnx", "nanotrack_v2_head.onnx"]
    missing = [n for n in names if not (folder / n).is_file()]
    if missing:
        where = f"{folder} has no {' and no '.join(missing)}"
        print(f"left out: NanoTrack: {where}; pass their folder as --peers", file=sys.stderr)
        return
    try:
        import cv2
        import numpy as np
    except ImportError as e:
        print(f"left out: NanoTrack: {e}; pip install opencv-python-headless numpy", file=sys.stderr)
        return
    if not hasattr(cv2, "TrackerNano_create"):
        print(f"left out: NanoTrack: OpenCV {cv2.__version__} has no TrackerNano", file=sys.stderr)
        return
    cv2.setNumThreads(threads)
    params = cv2.TrackerNano_Params()
    params.backbone, params.neckhead = (str(folder / n) for n in names)
    try:
        tracker = cv2.TrackerNano_create(params)
        # A textured square on noise, wandering.
        rng = np.random.default_rng(1)
        ground = rng.integers(0, 90, (480, 640, 3), np.uint8)
        target = rng.integers(120, 255, (60, 60, 3), np.uint8)
        at = [0]

        def picture():
            image = ground.copy()
            x = 200 + at[0] % 40
            image[200:260, x:x + 60] = target
            at[0] += 1
            return image

        tracker.init(picture(), (200, 200, 60, 60))
        pictures = [picture() for _ in range(16)]
        turn = iter(range(1 << 30))
        figures = measure(lambda: tracker.update(pictures[next(turn) % 16]), frames)
    except cv2.error as e:
        print(f"left out: NanoTrack: OpenCV {cv2.__version__}: {e}", file=sys.stderr)
        return
    yield f"opencv {cv2.__version__} NanoTrack v2", figures


def run_tsda(program, bundles, threads, frames):
    for bundle in bundles:
        command = [program, "bench", "--json", "--threads", str(threads), "--frames", str(frames)]
        command += ["--bundle", bundle] if bundle else []
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode != 0:
            print(f"left out: {' '.join(command)}: exit {done.returncode}", file=sys.stderr)
            continue
        for row in json.loads(done.stdout)["engines"]:
            # Two bundles of one preset, such as one of floats and one of bytes, stay apart.
            file = pathlib.Path(bundle).stem if bundle else ""
            words = ["tsda", row["engine"], file, row.get("preset", "")]
            name = " ".join(dict.fromkeys(w for w in words if w))
            if "unavailable" in row:
                print(f"left out: {name}: {row['unavailable']}", file=sys.stderr)
            else:
                yield name, {key: row[key] for key in ("cpu_ms_p50", "wall_ms_p50", "p95")}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--presets", default="tomp101,tomp50", help="networks for PyTorch; empty for none")
    parser.add_argument("--peers", type=pathlib.Path, default=ROOT / "../shared/data/peers")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--tsda", help="the program, measured in the same run")
    parser.add_argument("--bundles", default="", help="bundles for --tsda; the embedded one without")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    presets = [p for p in args.presets.split(",") if p]
    unknown = [p for p in presets if p not in BLOCKS]
    if unknown or args.threads < 1 or args.frames < 1:
        parser.error(f"unknown presets {unknown}" if unknown else "--threads and --frames begin at 1")
    # Before the libraries are loaded, which read it once.
    os.environ["OMP_NUM_THREADS"] = str(args.threads)
    rows = {}
    if args.tsda:
        rows.update(run_tsda(args.tsda, args.bundles.split(","), args.threads, args.frames))
    rows.update(run_nanotrack(args.peers, args.threads, args.frames))
    rows.update(run_torch(presets, args.threads, args.frames))
    for name, f in rows.items():
        print(f"{name:<34} cpu p50 {f['cpu_ms_p50']:8.2f}  wall p50 {f['wall_ms_p50']:8.2f}  "
              f"p95 {f['p95']:8.2f} ms, {args.threads} thread(s)")
    # Ratios within a size of network: `tsda native nano` against NanoTrack, and so on.
    kind = lambda name: "nano" if "NanoTrack" in name else name.split()[-1]
    for name, f in rows.items():
        base = next(b for b in rows if kind(b) == kind(name))
        if base != name:
            ratio = rows[base]["cpu_ms_p50"] / max(f["cpu_ms_p50"], 1e-9)
            print(f"{base} / {name}: {ratio:.2f} x CPU")
    if args.json:
        part = args.json.with_name(args.json.name + ".part")
        part.write_text(json.dumps({"threads": args.threads, "rows": rows}, indent=2) + "\n")
        part.replace(args.json)
    return 0 if rows else 1


if __name__ == "__main__":
    sys.exit(main())
