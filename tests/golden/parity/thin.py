#!/usr/bin/env python3
"""Thins a folder of golden figures out, so that it can be committed.

    python3 tests/golden/parity/thin.py FULL_FOLDER tests/golden/parity/small

Maps keep every 16th channel and every third row and column, tokens every 27th; names say so
(`.ch_step16`, `.tok_step27`). Inputs keep labels and boxes; crops follow the recipe.
"""
import json
import os
import struct
import sys

import numpy as np


def read(path):
    raw = open(path, "rb").read()
    size = struct.unpack("<Q", raw[:8])[0]
    head = json.loads(raw[8 : 8 + size])
    types = {"F32": "<f4", "U8": "u1"}
    return {
        name: np.frombuffer(
            raw[8 + size + e["data_offsets"][0] : 8 + size + e["data_offsets"][1]],
            types[e["dtype"]],
        ).reshape(e["shape"])
        for name, e in head.items()
        if name != "__metadata__"
    }


def write(path, tensors):
    head, body = {}, b""
    for name in sorted(tensors):
        t = np.ascontiguousarray(tensors[name])
        dtype = "U8" if t.dtype == np.uint8 else "F32"
        head[name] = {
            "dtype": dtype,
            "shape": list(t.shape),
            "data_offsets": [len(body), len(body) + t.nbytes],
        }
        body += t.tobytes()
    text = json.dumps(head, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    open(path, "wb").write(struct.pack("<Q", len(text)) + text + body)


def thin(name, t):
    if "key_padding_mask" in name:
        return name, t
    if "ltrb_mlp" in name:
        return name + ".tok_step27", t[:, :, ::27]
    if name.startswith("inter.encoder."):
        return name + ".tok_step27", t[::27]
    if t.ndim >= 4 and t.shape[-3] > 4 and t.shape[-1] > 1:
        t = t[..., ::16, :, :]
        if t.shape[-1] % 3 == 0 and t.shape[-1] > 9:
            t = t[..., ::3, ::3]
        return name + ".ch_step16", t
    return name, t


def main(full, out):
    inputs = read(os.path.join(full, "inputs.safetensors"))
    keep = {n: t for n, t in inputs.items() if n.endswith(("train_label", "train_ltrb", "train_box"))}
    write(os.path.join(out, "inputs.safetensors"), keep)
    for file in sorted(os.listdir(full)):
        if file.startswith("case_") and "train_step" not in file:
            figures = read(os.path.join(full, file))
            # The same maps stand in the file under two names.
            doubled = ("test_feat", "train_feat", "test_layer3", "train_layer3")
            if any(n.startswith("inter.test.") for n in figures):
                figures = {n: t for n, t in figures.items() if n not in doubled}
            write(os.path.join(out, file), dict(thin(n, t) for n, t in figures.items()))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
