"""Writes efficientnet_lite0_64.safetensors: EfficientNet-Lite0 to stride 16, in float64 numpy.

Independent of the Rust code: explicit loops over kernel taps, TensorFlow "SAME" padding from its
definition, batch norm not folded. Weights and image follow the filling recipe (`recipe` below,
which trainer/src/model/tests.rs implements too), so none are stored.

    python3 efficientnet_reference.py        (needs numpy)
"""
import json
import math
import os
import struct

import numpy as np

MASK = (1 << 64) - 1


def stream(name, count):
    h = 0xCBF29CE484222325
    for byte in name.encode():
        h = ((h ^ byte) * 0x100000001B3) & MASK
    with np.errstate(over="ignore"):
        i = np.arange(1, count + 1, dtype=np.uint64)
        z = np.uint64(h) + i * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def recipe(name, shape):
    name = "feature_extractor." + name
    count = math.prod(shape)
    r = 2.0 * ((stream(name, count) >> np.uint64(40)).astype(np.float64) * 2.0**-24) - 1.0
    if name.endswith("running_mean"):
        a, b = 0.0, 0.2
    elif name.endswith("running_var"):
        a, b = 1.0, 0.5
    elif len(shape) == 1:
        a, b = (1.0, 0.2) if name.endswith(".weight") else (0.0, 0.1)
    else:
        a, b = 0.0, math.sqrt(3.0 * 2.0 / (count // shape[0]))
    return (a + b * r).astype(np.float32).astype(np.float64).reshape(shape)


def image(frame, side):
    def tri(t, p):
        return abs(t % (2 * p) - p)

    z = (stream(f"image.{frame}", 3 * side * side) >> np.uint64(58)).astype(int)
    out = np.empty((3, side, side))
    for c in range(3):
        for y in range(side):
            for x in range(side):
                v = tri(3 * x + 5 * y + 40 * c + 31 * frame, 128) + tri(x + 2 * y + 17 * frame, 64)
                out[c, y, x] = min(255, v + z[(c * side + y) * side + x]) / 255.0
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    return (out - mean[:, None, None]) / std[:, None, None]


def conv(x, name, out, kernel, stride, depthwise=False):
    inp, h, w = x.shape
    weight = recipe(name + ".weight", (out, 1 if depthwise else inp, kernel, kernel))
    ho, wo = -(-h // stride), -(-w // stride)
    ph, pw = (max((o - 1) * stride + kernel - s, 0) for o, s in ((ho, h), (wo, w)))
    x = np.pad(x, ((0, 0), (ph // 2, ph - ph // 2), (pw // 2, pw - pw // 2)))
    y = np.zeros((out, ho, wo))
    for i in range(kernel):
        for j in range(kernel):
            tap = x[:, i:i + (ho - 1) * stride + 1:stride, j:j + (wo - 1) * stride + 1:stride]
            if depthwise:
                y += weight[:, 0, i, j][:, None, None] * tap
            else:
                y += np.einsum("oc,chw->ohw", weight[:, :, i, j], tap)
    return y


def norm(x, name):
    n = x.shape[0]
    weight, bias, mean, var = (recipe(f"{name}.{part}", (n,))
                               for part in ("weight", "bias", "running_mean", "running_var"))
    scale = weight / np.sqrt(var + 1e-3)
    return (x - mean[:, None, None]) * scale[:, None, None] + bias[:, None, None]


def relu6(x):
    return np.clip(x, 0.0, 6.0)


def main():
    x = relu6(norm(conv(image(0, 64), "_conv_stem", 32, 3, 2), "_bn0"))
    index = 0
    for kernel, stride, expand, inp, out, blocks in [
        (3, 1, 1, 32, 16, 1), (3, 2, 6, 16, 24, 2), (5, 2, 6, 24, 40, 2),
        (3, 2, 6, 40, 80, 3), (5, 1, 6, 80, 112, 3),
    ]:
        for i in range(blocks):
            name, s = f"_blocks.{index}.", stride if i == 0 else 1
            c = inp if i == 0 else out
            y = x
            if expand != 1:
                y = relu6(norm(conv(y, name + "_expand_conv", c * expand, 1, 1), name + "_bn0"))
            y = relu6(norm(conv(y, name + "_depthwise_conv", c * expand, kernel, s, True), name + "_bn1"))
            y = norm(conv(y, name + "_project_conv", out, 1, 1), name + "_bn2")
            x = x + y if s == 1 and c == out else y
            index += 1
    data = x.astype("<f4").tobytes()
    header = json.dumps({"feature": {"dtype": "F32", "shape": [1, *x.shape],
                                     "data_offsets": [0, len(data)]}}).encode()
    header += b" " * (-len(header) % 8)
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "efficientnet_lite0_64.safetensors")
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(header)) + header + data)
    print(x.shape, x.std(), np.abs(x).max())


if __name__ == "__main__":
    main()
