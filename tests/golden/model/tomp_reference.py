#!/usr/bin/env python3
"""ToMP-50 or ToMP-101 from the specification, in numpy and double precision.

Written apart from the Rust code, as the network is described (masked rows over all tokens, batch
norms unfolded). Weights and images follow the filling recipe, so any number of templates has
figures:
    python3 tests/golden/model/tomp_reference.py tomp50 3 FOLDER
    tsda-export golden --dir FOLDER --preset tomp50
A minute or two and 6 GB for ToMP-101.
"""
import json
import math
import os
import struct
import sys

import numpy as np

F, S, D, HEADS, FF = 18, 288, 256, 8, 2048
BLOCKS = {"tomp50": (3, 4, 6), "tomp101": (3, 4, 23)}


def stream(name, n):
    h = 0xCBF29CE484222325
    for byte in name.encode():
        h = ((h ^ byte) * 0x100000001B3) % (1 << 64)
    i = np.arange(1, n + 1, dtype=np.uint64)
    with np.errstate(over="ignore"):
        z = np.uint64(h) + i * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def weight(name, *shape):
    n = int(np.prod(shape))
    if name.endswith("running_mean"):
        a, b = 0, 0.2
    elif name.endswith("running_var"):
        a, b = 1, 0.5
    elif "query_embed" in name:
        a, b = 0, 1
    elif len(shape) == 1:
        a, b = (0.3, 0.1) if name.endswith("bn3.weight") else (1, 0.2) if name.endswith("weight") else (0, 0.1)
    else:
        g = 1.0
        if name.startswith("feature_extractor.") or ".tower." in name:
            g = 2.0
        elif name in ("head.classifier.linear.weight", "head.bb_regressor.linear.weight"):
            g = 1 / 64
        elif name == "head.bb_regressor.bbreg_layer.weight":
            g = 0.25
        a, b = 0, math.sqrt(3 * g / (n / shape[0]))
    r = 2 * ((stream(name, n) >> np.uint64(40)).astype(np.float64) * 2.0**-24) - 1
    return (a + b * r).astype(np.float32).astype(np.float64).reshape(shape)


def image(f):
    noise = (stream(f"image.{f}", 3 * S * S) >> np.uint64(58)).astype(np.int64).reshape(3, S, S)
    c, y, x = np.meshgrid(np.arange(3), np.arange(S), np.arange(S), indexing="ij")
    tri = lambda t, p: abs(t % (2 * p) - p)
    v = np.minimum(255, tri(3 * x + 5 * y + 40 * c + 31 * f, 128) + tri(x + 2 * y + 17 * f, 64) + noise)
    mean = np.array([0.485, 0.456, 0.406], np.float32).reshape(3, 1, 1)
    std = np.array([0.229, 0.224, 0.225], np.float32).reshape(3, 1, 1)
    return ((v.astype(np.float32) / np.float32(255) - mean) / std).astype(np.float64)


def conv(x, w, stride=1, bias=None):
    out, inp, k, _ = w.shape
    p = k // 2
    x = np.pad(x, ((0, 0), (p, p), (p, p)))
    h, wd = (x.shape[1] - k) // stride + 1, (x.shape[2] - k) // stride + 1
    y = np.zeros((out, h * wd))
    for i in range(k):
        for j in range(k):
            part = x[:, i : i + stride * h : stride, j : j + stride * wd : stride]
            y += w[:, :, i, j] @ part[:, :h, :wd].reshape(inp, -1)
    y = y.reshape(out, h, wd)
    return y if bias is None else y + bias.reshape(-1, 1, 1)


def bn(x, name, c, eps=1e-5):
    at = lambda n: weight(f"{name}.{n}", c).reshape(-1, *[1] * (x.ndim - 1))
    return (x - at("running_mean")) / np.sqrt(at("running_var") + eps) * at("weight") + at("bias")


relu = lambda x: np.maximum(x, 0)


def backbone(x, blocks):
    fe = "feature_extractor"
    x = relu(bn(conv(x, weight(f"{fe}.conv1.weight", 64, 3, 7, 7), 2), f"{fe}.bn1", 64))
    p = np.pad(x, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    h = x.shape[1] // 2
    x = np.max([p[:, i : i + 2 * h : 2, j : j + 2 * h : 2] for i in range(3) for j in range(3)], axis=0)
    maps = [x]
    for stage, count in enumerate(blocks):
        mid = 64 << stage
        for b in range(count):
            name, inp = f"{fe}.layer{stage + 1}.{b}", x.shape[0]
            stride = 2 if b == 0 and stage else 1
            y = relu(bn(conv(x, weight(f"{name}.conv1.weight", mid, inp, 1, 1)), f"{name}.bn1", mid))
            y = relu(bn(conv(y, weight(f"{name}.conv2.weight", mid, mid, 3, 3), stride), f"{name}.bn2", mid))
            y = bn(conv(y, weight(f"{name}.conv3.weight", 4 * mid, mid, 1, 1)), f"{name}.bn3", 4 * mid)
            if b == 0:
                w = weight(f"{name}.downsample.0.weight", 4 * mid, inp, 1, 1)
                x = bn(conv(x, w, stride), f"{name}.downsample.1", 4 * mid)
            x = relu(x + y)
        maps.append(x)
    return maps


def head_feature(x):
    y = conv(x, weight("head.feature_extractor.0.weight", D, 1024, 3, 3))
    return y * math.sqrt(1 / D) * math.sqrt(y.size / ((y**2).sum() + 1e-5))


def position():
    at = (np.arange(F) + 0.5) / (F + 1e-6)
    turn = np.arange(1, D // 4 + 1) * (F / (D // 4)) * math.pi
    x, y = np.meshgrid(at, at)
    code = np.zeros((F * F, D))
    for k, fn in enumerate((np.sin, np.cos)):
        code[:, k * D // 2 : (k + 1) * D // 2 : 2] = fn(np.outer(x.ravel(), turn))
        code[:, k * D // 2 + 1 : (k + 1) * D // 2 : 2] = fn(np.outer(y.ravel(), turn))
    return code


def norm(x, name):
    x = x - x.mean(-1, keepdims=True)
    x = x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-5)
    return x * weight(f"{name}.weight", D) + weight(f"{name}.bias", D)


def attention(q, k, v, name, hidden=None):
    w, b = weight(f"{name}.in_proj_weight", 3 * D, D), weight(f"{name}.in_proj_bias", 3 * D)
    part = lambda x, i: (x @ w[i * D : (i + 1) * D].T + b[i * D : (i + 1) * D]).reshape(len(x), HEADS, -1)
    q, k, v = part(q, 0), part(k, 1), part(v, 2)
    logits = np.einsum("qhc,khc->hqk", q, k) / math.sqrt(D // HEADS)
    if hidden is not None:
        logits[:, :, hidden] = -np.inf
    e = np.exp(logits - logits.max(-1, keepdims=True))
    mixed = np.einsum("hqk,khc->qhc", e / e.sum(-1, keepdims=True), v).reshape(-1, D)
    return mixed @ weight(f"{name}.out_proj.weight", D, D).T + weight(f"{name}.out_proj.bias", D)


def feed_forward(x, name):
    h = relu(x @ weight(f"{name}.linear1.weight", FF, D).T + weight(f"{name}.linear1.bias", FF))
    return h @ weight(f"{name}.linear2.weight", D, FF).T + weight(f"{name}.linear2.bias", D)


def transformer(tokens, hidden, e_fg):
    base = "head.filter_predictor.transformer"
    p = np.tile(position(), (len(tokens) // (F * F), 1))
    x, layers = tokens, []
    for i in range(6):
        n = f"{base}.encoder.layers.{i}"
        x = norm(x + attention(x + p, x + p, x, f"{n}.self_attn", hidden), f"{n}.norm1")
        x = norm(x + feed_forward(x, n), f"{n}.norm2")
        layers.append(x)
    t = np.zeros((1, D))
    for i in range(6):
        n = f"{base}.decoder.layers.{i}"
        t = norm(t + attention(t + e_fg, t + e_fg, t, f"{n}.self_attn"), f"{n}.norm1")
        t = norm(t + attention(t + e_fg, x + p, x, f"{n}.multihead_attn", hidden), f"{n}.norm2")
        t = norm(t + feed_forward(t, n), f"{n}.norm3")
    return norm(t, f"{base}.decoder.norm")[0], x[-F * F :], layers


def ltrb_tokens(ltrb):
    n, x = "head.filter_predictor.box_encoding", ltrb.reshape(4, -1)
    for i, (inp, out) in ((0, (4, 64)), (3, (64, D)), (6, (D, D))):
        x = weight(f"{n}.{i}.weight", out, inp, 1)[:, :, 0] @ x + weight(f"{n}.{i}.bias", out)[:, None]
        if i < 6:
            x = relu(bn(x, f"{n}.{i + 1}", out))
    return x.T


def tower(filt, enc):
    n = "head.bb_regressor"
    v = weight(f"{n}.linear.weight", D, D) @ filt + weight(f"{n}.linear.bias", D)
    x = ((enc @ v)[:, None] * enc).T.reshape(D, F, F)
    for i in range(0, 12, 3):
        x = conv(x, weight(f"{n}.tower.{i}.weight", D, D, 3, 3), 1, weight(f"{n}.tower.{i}.bias", D))
        x = (x - x.mean()) / np.sqrt(x.var() + 1e-5)
        scale, shift = (weight(f"{n}.tower.{i + 1}.{w}", D) for w in ("weight", "bias"))
        x = relu(x * scale.reshape(-1, 1, 1) + shift.reshape(-1, 1, 1))
    out = conv(x, weight(f"{n}.bbreg_layer.weight", 4, D, 3, 3), 1, weight(f"{n}.bbreg_layer.bias", 4))
    return np.exp(out)


def scores(filt, enc):
    w = weight("head.classifier.linear.weight", D, D) @ filt + weight("head.classifier.linear.bias", D)
    return (enc @ w).reshape(F, F)


def write(path, tensors):
    head, body = {}, b""
    for name in sorted(tensors):
        t = np.ascontiguousarray(tensors[name], dtype="<f4")
        head[name] = {"dtype": "F32", "shape": list(t.shape), "data_offsets": [len(body), len(body) + t.nbytes]}
        body += t.tobytes()
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    with open(path, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + body)


def main(preset, count, folder):
    cell = 16 * np.arange(F) + 8.0
    boxes = np.array([[112.3 + 5 * i, 118.7 - 4 * i, 55.1 + 6 * i, 61.4 - 3 * i] for i in range(count)], np.float32)
    labels, ltrbs = [], []
    for x, y, w, h in boxes.astype(np.float64):
        bell = lambda c: np.exp(-((np.arange(F) - 8.5 - F * (c - S / 2) / S) ** 2) / (2 * 0.9**2))
        labels.append(np.outer(bell(y + h / 2), bell(x + w / 2)))
        cx, cy = np.meshgrid(cell, cell)
        ltrbs.append(np.stack([cx - x, cy - y, x + w - cx, y + h - cy]) / S)
    out = {}
    features = []
    for f in range(count + 1):
        maps = backbone(image(f), BLOCKS[preset])
        features.append(head_feature(maps[3]))
        print(f"image {f} done", flush=True)
    out["test.stem_maxpool.ch_step8"], out["test.layer1.ch_step32"] = maps[0][::8, ::3, ::3], maps[1][::32, ::3, ::3]
    out["test.layer2.ch_step32"], out["test.layer3.ch_step32"] = maps[2][::32, ::2, ::2], maps[3][::32]
    out["test.head_feat.ch_step4"] = features[-1][::4]
    out["train.head_feat.ch_step16"] = np.stack([t[::16] for t in features[:-1]])
    fp = "head.filter_predictor"
    e_fg, e_test = weight(f"{fp}.query_embed_fg.weight", 1, D), weight(f"{fp}.query_embed_test.weight", 1, D)
    tokens = [
        t.reshape(D, -1).T + l.reshape(-1, 1) * e_fg + ltrb_tokens(b) for t, l, b in zip(features, labels, ltrbs)
    ]
    search = features[-1].reshape(D, -1).T + e_test
    for n in range(1, count + 1):
        sequence = np.concatenate(tokens[:n] + [search])
        hidden = np.zeros(len(sequence), bool)
        hidden[F * F : n * F * F] = True
        rows = [transformer(sequence, mask, e_fg) for mask in (None, hidden)]
        p = f"parallel{n}"
        for which, (filt, enc, _) in zip(("cls", "reg"), rows):
            out[f"{p}.{which}_filter"] = filt.reshape(1, D, 1, 1)
            out[f"{p}.{which}_enc.ch_step4"] = enc.T.reshape(D, F, F)[::4]
        out[f"{p}.scores"] = scores(*rows[0][:2]).reshape(1, 1, F, F)
        out[f"{p}.ltrb"] = tower(*rows[1][:2]).reshape(1, 1, 4, F, F)
        out[f"single{n}.scores"] = out[f"{p}.scores"]
        out[f"single{n}.ltrb"] = tower(*rows[0][:2]).reshape(1, 1, 4, F, F)
        for i in (0, 5):
            layer = np.stack([row[2][i] for row in rows], axis=1)
            out[f"{p}.encoder.layer{i}.tok_step27"] = layer[::27]
        print(f"{n} templates done", flush=True)
    os.makedirs(folder, exist_ok=True)
    inputs = {"boxes": boxes, "train_label": np.stack(labels)[:, None], "train_ltrb": np.stack(ltrbs)}
    write(os.path.join(folder, "inputs.safetensors"), inputs)
    write(os.path.join(folder, f"{preset}.safetensors"), out)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
