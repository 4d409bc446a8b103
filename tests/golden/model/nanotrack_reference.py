"""Writes nanotrack_64.safetensors: the backbones of NanoTrack v2 and v3, in float64 numpy.

Independent of the Rust code: explicit loops over kernel taps, batch norm and gates not folded. Two
pairs of figures: on the filling recipe's weights and image (see efficientnet_reference.py), and on
the published weights and an image given by a formula. The published ONNX file of v2, run by ONNX
Runtime, gives the figure `published_v2` and is what the numpy code is checked against.

    python3 nanotrack_reference.py V2.safetensors V3.safetensors V2.onnx
    (needs numpy, safetensors, onnx, onnxruntime; state dicts with the names of the checkpoints)
"""
import json
import os
import struct
import sys

import numpy as np

from efficientnet_reference import image, recipe

SIDE = 64


def relu(x):
    return np.maximum(x, 0.0)


def hard_sigmoid(x):
    return np.clip(x / 6.0 + 0.5, 0.0, 1.0)


def hard_swish(x):
    return x * hard_sigmoid(x)


# Kernel, expanded channels, channels out, stride, width of the gate (0: none), activation.
BLOCKS = [
    (3, 16, 16, 2, 8, relu), (3, 72, 24, 2, 0, relu), (3, 88, 24, 1, 0, relu),
    (5, 96, 40, 2, 24, hard_swish), (5, 240, 40, 1, 64, hard_swish),
    (5, 240, 40, 1, 64, hard_swish), (5, 120, 48, 1, 32, hard_swish),
    (5, 144, 48, 1, 40, hard_swish), (5, 288, 96, 1, 72, hard_swish),
]


def published(path):
    from safetensors.numpy import load_file
    tensors = load_file(path)

    def weight(name, shape):
        found = tensors["backbone." + name].astype(np.float64)
        assert found.shape == shape, (name, found.shape, shape)
        return found
    return weight


def conv(x, weight, stride):
    out, per_group, k, _ = weight.shape
    x = np.pad(x, ((0, 0), (k // 2, k // 2), (k // 2, k // 2)))
    h, w = ((side - k) // stride + 1 for side in x.shape[1:])
    y = np.zeros((out, h, w))
    for i in range(k):
        for j in range(k):
            tap = x[:, i:i + stride * (h - 1) + 1:stride, j:j + stride * (w - 1) + 1:stride]
            if per_group == 1:
                y += weight[:, 0, i, j][:, None, None] * tap
            else:
                y += np.einsum("oc,chw->ohw", weight[:, :, i, j], tap)
    return y


def backbone(weight, x, count):
    def norm(x, name):
        n = x.shape[0]
        gain, bias, mean, var = (weight(f"{name}.{part}", (n,))
                                 for part in ("weight", "bias", "running_mean", "running_var"))
        scale = gain / np.sqrt(var + 1e-5)
        return (x - mean[:, None, None]) * scale[:, None, None] + bias[:, None, None]

    def gate(x, name, hidden):
        n = x.shape[0]
        y = weight(f"{name}.fc.0.weight", (hidden, n)) @ x.mean((1, 2))
        y = relu(y + weight(f"{name}.fc.0.bias", (hidden,)))
        y = weight(f"{name}.fc.2.weight", (n, hidden)) @ y + weight(f"{name}.fc.2.bias", (n,))
        return x * hard_sigmoid(y)[:, None, None]

    x = hard_swish(norm(conv(x, weight("features.0.0.weight", (16, 3, 3, 3)), 2), "features.0.1"))
    inp = 16
    for i, (k, mid, out, stride, hidden, activation) in enumerate(BLOCKS[:count], 1):
        p = f"features.{i}.conv."
        if i == 1:
            y = activation(norm(conv(x, weight(p + "0.weight", (mid, 1, k, k)), stride), p + "1"))
            y = gate(y, p + "3", hidden)
            y = norm(conv(y, weight(p + "4.weight", (out, mid, 1, 1)), 1), p + "5")
        else:
            y = activation(norm(conv(x, weight(p + "0.weight", (mid, inp, 1, 1)), 1), p + "1"))
            y = norm(conv(y, weight(p + "3.weight", (mid, 1, k, k)), stride), p + "4")
            if hidden:
                y = gate(y, p + "5", hidden)
            y = norm(conv(activation(y), weight(p + "7.weight", (out, mid, 1, 1)), 1), p + "8")
        x = x + y if stride == 1 and inp == out else y
        inp = out
    return x


def formula():
    """B, G, R from 0 to 255."""
    c, y, x = np.meshgrid(np.arange(3), np.arange(SIDE), np.arange(SIDE), indexing="ij")
    return ((x * 7 + y * 13 + c * 29 + x * y) % 256).astype(np.float64)


def run_onnx(path, x):
    import onnx
    import onnxruntime
    model = onnx.load(path)
    for i, side in enumerate(x.shape):
        model.graph.input[0].type.tensor_type.shape.dim[i + 1].dim_value = side
    del model.graph.output[0].type.tensor_type.shape.dim[:]
    session = onnxruntime.InferenceSession(model.SerializeToString())
    return session.run(None, {"input": x[None].astype(np.float32)})[0][0]


def main(v2, v3, onnx_v2):
    theirs, ours = run_onnx(onnx_v2, formula()), backbone(published(v2), formula(), 8)
    off = np.abs(theirs - ours).max() / np.abs(theirs).max()
    print(f"v2 against its ONNX file: {off:.1e} of the largest value")
    assert off < 1e-5
    figures = {
        "recipe_v2": backbone(recipe, image(0, SIDE), 8),
        "recipe_v3": backbone(recipe, image(0, SIDE), 9),
        "published_v2": theirs,
        "published_v3": backbone(published(v3), formula(), 9),
    }
    table, data = {}, b""
    for name, figure in figures.items():
        print(name, figure.shape, figure.std(), np.abs(figure).max())
        raw = figure.astype("<f4").tobytes()
        table[name] = {"dtype": "F32", "shape": [1, *figure.shape],
                       "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    header = json.dumps(table).encode()
    header += b" " * (-len(header) % 8)
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), "nanotrack_64.safetensors")
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(header)) + header + data)


if __name__ == "__main__":
    main(*sys.argv[1:])
