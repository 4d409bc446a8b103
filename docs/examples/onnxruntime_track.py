#!/usr/bin/env python3
"""Finds a target in a second picture with ONNX Runtime alone, one template, no memory.

    tsda-export unpack models/nano.tsda nano-onnx
    python3 docs/examples/onnxruntime_track.py nano-onnx first.png X,Y,W,H second.png

Prints the found box x,y,w,h in pixels and its score. Needs: pip install onnxruntime numpy pillow.
Crops are those of the tracker away from the picture's borders and for targets that fill less than two crop pixels
per pixel; docs/tracker.md (spec 3.3 and 3.4) has the rest, and what it does with the score over time.
"""
import json, pathlib, sys
import numpy as np, onnxruntime
from PIL import Image

folder, first, box, second = pathlib.Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4]
spec = json.loads((folder / "manifest.json").read_text())["spec"]
side, cells = spec["crop"], spec["crop"] // 16
graphs = {name: onnxruntime.InferenceSession(folder / f"{name}.onnx") for name in ("features", "template", "predict1")}

def window(centre, size):
    """First pixel and number of pixels of the tracker's window of `size`, which are whole numbers (spec 3.4)."""
    first, end = int(int(centre) - (size - 1) / 2), int(int(centre) + size / 2 + 1)
    return first, end - first

def feature(picture, x, y, part=0.0):
    """Head feature of the windows `x` and `y`, without `part` of them on every side; edges repeat."""
    image = np.asarray(Image.open(picture).convert("RGB"), np.float32)
    def axis(first, length, size):
        share = part + (1 - 2 * part) * (np.arange(side) + 0.5) / side
        at = np.clip(first - 0.5 + share * length, 0, size - 1)
        low = at.astype(int)
        return low, np.minimum(low + 1, size - 1), (at - low).astype(np.float32)
    (y0, y1, fy), (x0, x1, fx) = axis(*y, image.shape[0]), axis(*x, image.shape[1])
    fy, fx = fy[:, None, None], fx[None, :, None]
    rows = lambda y: image[y][:, x0] * (1 - fx) + image[y][:, x1] * fx
    crop = ((rows(y0) * (1 - fy) + rows(y1) * fy) / 255 - spec["input_mean"]) / spec["input_std"]
    return graphs["features"].run(None, {"crop": crop.transpose(2, 0, 1)[None].astype(np.float32)})[0]

x, y, w, h = map(float, box.split(","))
cx, cy, scale = x + (w - 1) / 2, y + (h - 1) / 2, spec["search_factor"] * (w * h) ** 0.5 / side
sigma = spec["label_sigma"] / spec["search_factor"] * cells
bell = np.exp(-((np.arange(cells) - (cells - 1) / 2) ** 2) / (2 * sigma**2))
gx, gy = np.meshgrid(16 * np.arange(cells) + 8 - side / 2, 16 * np.arange(cells) + 8 - side / 2)
reach = np.stack([w / 2 / scale + gx, h / 2 / scale + gy, w / 2 / scale - gx, h / 2 / scale - gy])
double = round(2 * side * scale)  # the template is the middle of a window twice as wide
template = feature(first, window(round(cx), double), window(round(cy), double), part=0.25)
inputs = {"feature": template, "label": np.outer(bell, bell), "ltrb": reach / side}
tokens = graphs["template"].run(None, {k: v.astype(np.float32) for k, v in inputs.items()})[0]

if cells % 2 == 0:  # no cell in the middle: put the target on one
    cx, cy = cx + 8 * scale, cy + 8 * scale
wx, wy = window(cx, int(side * scale)), window(cy, int(side * scale))
search = feature(second, wx, wy)
scores, ltrb = graphs["predict1"].run(["scores", "ltrb"], {"template0": tokens, "feature": search})
row, column = np.unravel_index(scores.argmax(), scores.shape)
left, top, right, bottom = ltrb[:, row, column] * side * scale
px, py = (first + (16 * cell + 8) / side * length for (first, length), cell in ((wx, column), (wy, row)))
print(f"{px - left:.2f},{py - top:.2f},{left + right:.2f},{top + bottom:.2f} score {scores.max():.3f}")
