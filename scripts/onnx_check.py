#!/usr/bin/env python3
"""Checks an unpacked bundle with the onnx package and ONNX Runtime.

    tsda-export unpack models/nano.tsda nano-onnx
    python3 scripts/onnx_check.py nano-onnx [--tolerance 1e-4]

Runs onnx.checker (full check, shape inference included) on every graph, then drives the probe
through ONNX Runtime and compares its maps with those of the trainer's own network (probe.bin).
Needs: pip install onnx onnxruntime numpy. Exit code 0 when all is well, 1 for a difference above the
tolerance, 2 for anything unusable, 3 when a package is missing.
"""

import argparse
import json
import pathlib
import struct
import sys

try:
    import numpy as np
    import onnx
    import onnxruntime
except ImportError as error:
    print(f"missing package: {error.name}; pip install onnx onnxruntime numpy", file=sys.stderr)
    sys.exit(3)

MASK = (1 << 64) - 1


def recipe_image(index, side):
    """Recipe image `index` as floats 0..255, (3, side, side); see runtime/src/probe.rs."""
    seed = 0xCBF29CE484222325
    for byte in f"image.{index}".encode():
        seed = ((seed ^ byte) * 0x100000001B3) & MASK
    c, y, x = np.meshgrid(np.arange(3), np.arange(side), np.arange(side), indexing="ij")

    def triangle(t, p):
        return np.abs(t % (2 * p) - p)

    i = ((c * side + y) * side + x).astype(np.uint64)
    with np.errstate(over="ignore"):
        z = np.uint64(seed) + (i + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    noise = (z >> np.uint64(58)).astype(np.int64)
    value = triangle(3 * x + 5 * y + 40 * c + 31 * index, 128)
    value = value + triangle(x + 2 * y + 17 * index, 64) + noise
    return np.minimum(value, 255).astype(np.float32)


def crop(spec, index):
    """Network input (1, 3, S, S)."""
    mean = np.array(spec["input_mean"], np.float32).reshape(3, 1, 1)
    std = np.array(spec["input_std"], np.float32).reshape(3, 1, 1)
    image = recipe_image(index, spec["crop"]) / np.float32(255)
    return ((image - mean) / std).astype(np.float32)[None]


def template_maps(spec, box):
    """Label (F, F) and box distances (4, F, F) of a box x, y, w, h in crop pixels (spec 1.4, 2.4)."""
    side, cells = spec["crop"], spec["crop"] // 16
    x, y, w, h = (float(v) for v in box)
    sigma = spec["label_sigma"] / spec["search_factor"] * cells
    steps = np.arange(cells) - (cells - 1) / 2

    def bell(middle):
        return np.exp(-((steps - cells / side * (middle - side / 2)) ** 2) / (2 * sigma * sigma))

    label = np.outer(bell(y + h / 2), bell(x + w / 2)).astype(np.float32)
    centre = 16 * np.arange(cells) + 8
    ys, xs = np.meshgrid(centre, centre, indexing="ij")
    ltrb = np.stack([xs - x, ys - y, x + w - xs, y + h - ys]) / side
    return label, ltrb.astype(np.float32)


def read_probe(path, cells):
    """Boxes, and per number of templates (scores, ltrb)."""
    data = path.read_bytes()
    magic, templates, side = struct.unpack_from("<4sII", data)
    if magic != b"PRB1" or side != cells:
        raise ValueError(f"{path} is no probe for maps of side {cells}")
    numbers = np.frombuffer(data, "<f4", offset=12)
    boxes, numbers = numbers[: 4 * templates].reshape(-1, 4), numbers[4 * templates :]
    blocks = numbers.reshape(templates, 5, cells, cells)
    return boxes, [(block[0], block[1:]) for block in blocks]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path, help="what tsda-export unpack wrote")
    parser.add_argument("--tolerance", type=float, default=1e-4)
    arguments = parser.parse_args()
    folder = arguments.folder
    spec = json.loads((folder / "manifest.json").read_text())["spec"]
    cells = spec["crop"] // 16
    names = ["features", "template"] + [f"predict{k}" for k in range(1, spec["templates"] + 1)]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    sessions = {}
    for name in names:
        path = folder / f"{name}.onnx"
        onnx.checker.check_model(str(path), full_check=True)
        model = onnx.load(str(path), load_external_data=False)
        print(f"{name}: {len(model.graph.node)} nodes, checker ok")
        sessions[name] = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )

    boxes, expected = read_probe(folder / "probe.bin", cells)
    tokens = []
    for index in range(len(boxes) + 1):
        (feature,) = sessions["features"].run(["feature"], {"crop": crop(spec, index)})
        if index < len(boxes):
            label, ltrb = template_maps(spec, boxes[index])
            feeds = {"feature": feature, "label": label, "ltrb": ltrb}
            tokens += sessions["template"].run(["tokens"], feeds)
    worst = 0.0
    for k, (scores, ltrb) in enumerate(expected, start=1):
        feeds = {f"template{i}": tokens[i] for i in range(k)} | {"feature": feature}
        got = sessions[f"predict{k}"].run(["scores", "ltrb"], feeds)
        for name, value, want in zip(["scores", "ltrb"], got, [scores, ltrb]):
            difference = float(np.abs(value - want).max())
            worst = max(worst, difference if np.isfinite(difference) else np.inf)
            print(f"onnxruntime predict{k} {name}: max abs diff {difference:.3e}")
    print(f"largest difference {worst:.3e}, allowed {arguments.tolerance:.3e}")
    return 0 if worst <= arguments.tolerance else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Exception as error:  # noqa: BLE001 - one line for people, code 2 for scripts
        print(f"error: {type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(2)
