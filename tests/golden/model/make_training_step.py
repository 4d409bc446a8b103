"""Thins out the reference's training step to what the tests need.

    python make_training_step.py case_t_train_step_dropout0.safetensors training_step.safetensors

Figures and running statistics are kept whole. Of every gradient, and of every parameter after the
step, the file has `[largest absolute value, samples ..]`: sample k is element
`k * 2654435761 mod numel` of the flattened tensor, 48 of them, or all elements in order of a tensor
with no more.
"""

import json
import struct
import sys

import numpy as np

SAMPLES = 48
DTYPES = {"F32": np.float32, "U8": np.uint8}


def read(path):
    raw = open(path, "rb").read()
    length = struct.unpack("<Q", raw[:8])[0]
    table = json.loads(raw[8 : 8 + length])
    table.pop("__metadata__", None)
    out = {}
    for name, entry in table.items():
        a, b = (8 + length + at for at in entry["data_offsets"])
        out[name] = np.frombuffer(raw[a:b], DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return out


def write(path, tensors):
    table, data = {}, b""
    for name, t in sorted(tensors.items()):
        raw = np.ascontiguousarray(t, np.float32).tobytes()
        table[name] = {"dtype": "F32", "shape": list(t.shape), "data_offsets": [len(data), len(data) + len(raw)]}
        data += raw
    text = json.dumps(table, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    open(path, "wb").write(struct.pack("<Q", len(text)) + text + data)


def thinned(t):
    flat = t.flatten()
    if flat.size > SAMPLES:
        index = [k * 2654435761 % flat.size for k in range(SAMPLES)]
    else:
        index = range(flat.size)
    return np.concatenate([[np.abs(flat).max()], flat[list(index)]]).astype(np.float32)


if __name__ == "__main__":
    out = {}
    for name, t in read(sys.argv[1]).items():
        out[name] = thinned(t) if name.startswith(("grad.", "after_step.")) else t
    write(sys.argv[2], out)
