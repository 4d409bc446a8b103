#!/usr/bin/env python3
"""Expected figures of a tracker script, computed from the specification in numpy (spec 3).

Written apart from the tracker, in double precision and without looking at it, so that `tsda replay`
is checked on other picture sizes, map sizes, thresholds and numbers of slots than the recorded runs
of the reference have. Writes second_script.json and second_script.safetensors beside itself:
    python3 tests/golden/runtime/second_script.py
"""
import json
import math
import os
import struct

import numpy as np


def stream(name, n):
    """n words of the recipe's stream of a name."""
    h = 0xCBF29CE484222325
    for byte in name.encode():
        h = ((h ^ byte) * 0x100000001B3) % (1 << 64)
    i = np.arange(1, n + 1, dtype=np.uint64)
    with np.errstate(over="ignore"):
        z = np.uint64(h) + i * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def picture(frame, h, w):
    noise = (stream(f"image.{frame}", 3 * h * w) >> np.uint64(58)).astype(np.int64)
    c, y, x = np.meshgrid(np.arange(3), np.arange(h), np.arange(w), indexing="ij")
    tri = lambda t, p: abs(t % (2 * p) - p)
    wave = tri(3 * x + 5 * y + 40 * c + 31 * frame, 128) + tri(x + 2 * y + 17 * frame, 64)
    return np.minimum(255, wave + noise.reshape(3, h, w)).astype(np.float64)


def half_even(v):
    return np.round(np.asarray(v, dtype=np.float64))


def axis_window(image, pos, n, inside):
    """Real-valued edges along one axis (spec 3.4, steps 5 and 6)."""
    low, high = pos - (n - 1) / 2, pos + n / 2 + 1
    if inside:
        shift = max(-low, 0) - max(high - image, 0)
        low, high = low + shift, high + shift
        out = math.floor((max(-low, 0) + max(high - image, 0)) / 2)
        if out > 0:
            shift = -low - out
            low, high = low + shift, high + shift
    return low, high


def cut(image, pos, size, output, inside, max_change):
    """Patch and its corners (y1, x1, y2, x2) (spec 3.4)."""
    h, w = image.shape[1:]
    p = [math.trunc(pos[0]), math.trunc(pos[1])]
    if inside:
        size = math.trunc(size / min(max(min(size / h, size / w), 1), max_change))
    df = max(math.trunc(size / output - 0.1), 1)
    z = size / df
    if df > 1:
        off = [p[0] % df, p[1] % df]
        p = [(p[0] - off[0]) // df, (p[1] - off[1]) // df]
        image = image[:, off[0] :: df, off[1] :: df]
    n = math.trunc(max(half_even(z), 2))
    edges = [axis_window(image.shape[1 + a], p[a], n, inside) for a in (0, 1)]
    for a in (0, 1):
        low, high = (math.trunc(v) for v in edges[a])
        index = np.clip(np.arange(low, high), 0, image.shape[1 + a] - 1)
        image = np.take(image, index, axis=1 + a)
    for a in (1, 2):
        side = image.shape[a]
        at = np.maximum((np.arange(output) + 0.5) * side / output - 0.5, 0)
        near = np.minimum(at.astype(int), side - 1)
        far, weight = np.minimum(near + 1, side - 1), at - near
        weight = weight.reshape([-1 if i == a else 1 for i in range(3)])
        image = np.take(image, near, axis=a) * (1 - weight) + np.take(image, far, axis=a) * weight
    (y1, y2), (x1, x2) = edges
    return image, [df * y1, df * x1, df * y2, df * x2]


def samples(patch):
    s = patch.shape[1]
    rows, cols = [0, s // 2 - 1, s - 1], [0, 100, s - 1]
    return [[float(patch[k, r, cols[k]]) for r in rows] for k in range(3)]


def gaussian(f, centre, sigma):
    axis = lambda c: np.exp(-((np.arange(f) - (f - 1) / 2 - c) ** 2) / (2 * sigma**2))
    return np.outer(axis(centre[0]), axis(centre[1]))


class Tracker:
    """Spec 3, one target."""

    def __init__(self, f, params, factor, slots):
        self.f, self.s, self.params, self.factor, self.slots = f, 16 * f, params, factor, slots

    def memory_sample(self, sample_pos, sample_scale):
        c = (self.pos - sample_pos) / sample_scale + (self.s - 1) / 2
        size = self.tsz / sample_scale
        tl = c - (size - 1) / 2
        centre = self.f * (self.pos - sample_pos) / (sample_scale * self.s)
        label = gaussian(self.f, centre, 0.25 / self.factor * self.f)
        box = [tl[1], tl[0], size[1], size[0]]
        return box, label, {"label_max": float(label.max()), "label_argmax": int(label.argmax())}

    def init(self, image, box):
        x, y, w, h = box
        self.pos = np.array([y + (h - 1) / 2, x + (w - 1) / 2])
        self.tsz = np.array([h, w])
        self.scale = self.factor * math.sqrt(w * h) / self.s
        self.base = self.tsz / self.scale
        self.scales, self.nf, self.held, self.writes = [], 0, [0], 1
        p0 = half_even(self.pos)
        patch, _ = cut(image, p0, self.scale * 2 * self.s, 2 * self.s, False, None)
        m = self.s // 2
        patch = patch[:, m : m + self.s, m : m + self.s]
        target, _, label = self.memory_sample(p0, self.scale)
        return {
            "pos_yx": list(self.pos),
            "target_sz_hw": list(self.tsz),
            "target_scale": self.scale,
            "base_target_sz_hw": list(self.base),
            "init_sample_pos_yx": list(p0),
            "sigma": [0.25 / self.factor * self.f] * 2,
            "target_box_xywh": target,
            "num_gth_frames": 1,
            "patch_samples": samples(patch),
            "patch_mean": float(patch.mean()),
            **label,
        }

    def locate(self, s, sample_pos, sample_scale):
        """Flag and cell (spec 3.7)."""
        f, t = self.f, self.params
        peak = lambda m: min((-m[r, c], c, r) for c in range(f) for r in range(f))
        v, c1, r1 = peak(s)
        m1 = -v
        if m1 < t["not_found"]:
            return "not_found", (r1, c1)
        n = t["neighbourhood"] * (self.tsz / sample_scale) * f / self.s
        rest = s.copy()
        edge = lambda a: int(min(max(half_even(a), 0), f))
        r0, r2 = edge(r1 - n[0] / 2), edge(r1 + n[0] / 2 + 1)
        c0, c2 = edge(c1 - n[1] / 2), edge(c1 + n[1] / 2 + 1)
        rest[r0:r2, c0:c2] = 0
        v, cc, rr = peak(rest)
        m2 = -v
        mid = (f - 1) / 2
        vp = (self.pos - sample_pos) / (16 * sample_scale)
        far = t["displacement"] * f / 2
        a = math.hypot(r1 - mid - vp[0], c1 - mid - vp[1])
        b = math.hypot(rr - mid - vp[0], cc - mid - vp[1])
        if m2 > t["distractor"] * m1:
            if b > far and a < far:
                return "hard_negative", (r1, c1)
            if b < far and a > far:
                return "hard_negative", (rr, cc)
            return "uncertain", (r1, c1)
        if m2 > t["hard_negative"] * m1 and m2 > t["not_found"]:
            return "hard_negative", (r1, c1)
        return "normal", (r1, c1)

    def update(self, frame, image, s, ltrb):
        h, w = image.shape[1:]
        shift = 8 * self.scale if self.f % 2 == 0 else 0
        centre = self.pos + shift
        out = {"search_center_yx": list(centre), "search_scale": self.scale}
        patch, corners = cut(
            image, centre, self.scale * self.s, self.s, True, self.params["max_scale_change"]
        )
        y1, x1, y2, x2 = corners
        sample_pos = np.array([(y1 + y2 - 1) / 2, (x1 + x2 - 1) / 2])
        sample_scale = math.sqrt((y2 - y1) / self.s * (x2 - x1) / self.s)
        flag, (r, c) = self.locate(s, sample_pos, sample_scale)
        l, t, rr, b = (float(v) * self.s for v in ltrb[:, r, c])
        cx, cy = 16 * c + 8, 16 * r + 8
        to_x = lambda e: e / self.s * (x2 - x1) + x1
        to_y = lambda e: e / self.s * (y2 - y1) + y1
        raw = [to_x(cx - l), to_y(cy - t)]
        raw += [to_x(cx + rr) - raw[0], to_y(cy + b) - raw[1]]
        low = self.params["min_size"]
        bx, by = max(0, min(raw[0], w - low)), max(0, min(raw[1], h - low))
        bx2 = max(bx + low, min(raw[0] + raw[2], w))
        by2 = max(by + low, min(raw[1] + raw[3], h))
        clipped = [bx, by, bx2 - bx, by2 - by]
        if flag != "not_found":
            self.pos = np.array([by + clipped[3] / 2, bx + clipped[2] / 2])
            self.tsz = np.array([clipped[3], clipped[2]])
            self.scale = math.sqrt(clipped[2] * clipped[3] / (self.base[0] * self.base[1]))
            self.scales.append(self.scale)
        elif self.scales:
            self.nf += 1
            k = min(max(self.nf, 2), 30)
            kept = [v for v in self.scales[-60:] if v >= self.scales[-1]]
            self.scale = sum(kept[-k:]) / len(kept[-k:])
        score = float(s.max())
        write = flag in ("normal", "hard_negative") and score > self.params["write_confidence"]
        if write and self.slots > 1:
            self.writes += 1
            if len(self.held) < self.slots:
                slot = len(self.held)
                self.held.append(frame)
            else:
                slot = 1 + int(np.argmin(self.held[1:]))
                self.held[slot] = frame
            target, label, figures = self.memory_sample(sample_pos, sample_scale)
            out["memory"] = {
                "replaced_slot": slot,
                "target_box_xywh": target,
                "num_stored": self.writes,
                "slots_hold_frame": [float(v) for v in self.held],
                **figures,
            }
        hh, ww = self.tsz
        out |= {
            "frame": frame,
            "patch_coord_y1x1y2x2": corners,
            "patch_samples": samples(patch),
            "patch_mean": float(patch.mean()),
            "sample_pos_yx": list(sample_pos),
            "sample_scale": sample_scale,
            "flag": flag,
            "max_disp_rc": [int(r), int(c)],
            "bbox_raw_xywh": raw,
            "bbox_clipped_xywh": clipped,
            "output_bbox_xywh": [self.pos[1] - (ww - 1) / 2, self.pos[0] - (hh - 1) / 2, ww, hh],
            "object_presence_score": score,
            "pos_yx": list(self.pos),
            "target_sz_hw": list(self.tsz),
            "target_scale": self.scale,
            "not_found_counter": self.nf,
            "updated": "memory" in out,
        }
        return out


def maps(f, name, peaks, box):
    """A score map with peaks (row, column, height) on noise, and a noisy box everywhere."""
    noise = lambda what, n: (stream(f"{name}.{what}", n) >> np.uint64(40)).astype(float) / 2**24
    s = 0.04 * noise("s", f * f).reshape(f, f) - 0.03
    for r, c, height in peaks:
        s = np.maximum(s, height * gaussian(f, (r - (f - 1) / 2, c - (f - 1) / 2), 0.7))
        s[r, c] = height
    ltrb = np.array(box)[:, None, None] * (0.9 + 0.2 * noise("b", 4 * f * f).reshape(4, f, f))
    return s.astype(np.float32), ltrb.astype(np.float32)


TOMP = {
    "not_found": 0.25,
    "distractor": 0.8,
    "hard_negative": 0.5,
    "neighbourhood": 2.2,
    "displacement": 0.8,
    "write_confidence": 0.9,
    "min_size": 10.0,
    "max_scale_change": 1.5,
}
OTHER = TOMP | {
    "not_found": 0.3,
    "distractor": 0.7,
    "hard_negative": 0.4,
    "neighbourhood": 1.6,
    "displacement": 0.6,
    "write_confidence": 0.8,
    "min_size": 6.3,
    "max_scale_change": 1.3,
}
USUAL = [0.1, 0.1, 0.1, 0.1]
RUNS = [
    # name, rows, columns, map side, search factor, slots, thresholds, first box,
    # frames: peaks and box
    (
        "wide_270x480", 270, 480, 18, 5.0, 2, TOMP, [301.5, 88.25, 41.0, 63.5],
        [
            ([(8, 9, 0.97)], USUAL),
            ([(7, 8, 0.95), (14, 15, 0.9)], USUAL),
            ([(9, 9, 0.2)], USUAL),
            ([(9, 9, 0.99)], [0.3, 0.1, 0.3, 0.12]),
            ([(8, 0, 0.93), (9, 10, 0.91)], USUAL),
            ([(8, 9, 0.95), (12, 13, 0.9)], USUAL),
        ],
    ),
    (
        "tall_333x222", 333, 222, 10, 4.0, 3, OTHER, [80.3, 120.6, 52.2, 39.9],
        [
            ([(5, 5, 0.95)], [0.13, 0.12, 0.12, 0.13]),
            ([(4, 5, 0.75)], [0.12, 0.12, 0.13, 0.13]),
            ([(5, 4, 0.9), (1, 8, 0.5)], [0.14, 0.12, 0.13, 0.13]),
            ([(5, 5, 0.9), (9, 9, 0.8)], [0.12, 0.13, 0.12, 0.12]),
            ([(1, 1, 0.9), (5, 5, 0.85)], [0.13, 0.13, 0.12, 0.12]),
            ([(4, 4, 0.9), (6, 7, 0.89)], [0.16, 0.15, 0.16, 0.15]),
            ([(5, 5, 0.29)], [0.12, 0.12, 0.12, 0.12]),
            ([(5, 5, 0.1)], [0.12, 0.12, 0.12, 0.12]),
            ([(5, 5, -0.02)], [0.12, 0.12, 0.12, 0.12]),
            ([(5, 6, 0.99)], [0.08, 0.1, 0.09, 0.08]),
            ([(6, 7, 0.85)], [0.03, 0.02, 0.02, 0.03]),
            ([(5, 5, 0.85)], [0.02, 0.02, 0.01, 0.02]),
            ([(5, 5, 0.2)], [0.1, 0.1, 0.1, 0.1]),
            ([(4, 5, 0.82)], [0.6, 0.5, 0.5, 0.6]),
            ([(0, 0, 0.9)], [0.5, 0.5, 0.5, 0.5]),
            ([(9, 9, 0.9)], [0.4, 0.45, 0.9, 0.95]),
            ([(5, 5, 0.1)], [0.1, 0.1, 0.1, 0.1]),
            ([(5, 4, 0.9)], [0.9, 0.9, 0.8, 0.9]),
            ([(5, 5, 0.9), (5, 8, 0.9)], [0.2, 0.2, 0.2, 0.2]),
            ([(3, 5, 0.7)], [0.15, 0.15, 0.15, 0.15]),
            ([(5, 5, 0.81)], [0.12, 0.12, 0.12, 0.12]),
        ],
    ),
    (
        "odd_401x399", 401, 399, 9, 5.0, 1, TOMP | {"min_size": 20.1}, [150.0, 160.0, 210.0, 190.5],
        [
            ([(4, 4, 0.95)], USUAL),
            ([(4, 3, 0.3)], USUAL),
            ([(4, 4, 0.95)], [0.01, 0.02, 0.01, 0.02]),
        ],
    ),
]


def short(value):
    """Seven digits after the point are enough for every tolerance."""
    if isinstance(value, dict):
        return {k: short(v) for k, v in value.items()}
    if isinstance(value, list):
        return [short(v) for v in value]
    if isinstance(value, (bool, str)):
        return value
    return int(value) if isinstance(value, (int, np.integer)) else round(float(value), 7)


def main():
    runs, tensors = [], {}
    for name, h, w, f, factor, slots, params, box, frames in RUNS:
        tracker = Tracker(f, params, factor, slots)
        # The tracker reads boxes as single precision.
        box = [float(np.float32(v)) for v in box]
        run = {
            "name": name,
            "image_hw": [h, w],
            "image_formula": "image_u8(frame_number)",
            "init_bbox_xywh": box,
            "search_factor": factor,
            "templates": slots,
            "params": params,
            "init": tracker.init(picture(0, h, w), box),
            "frames": [],
        }
        for i, (peaks, ltrb_box) in enumerate(frames, 1):
            s, ltrb = maps(f, f"{name}.{i}", peaks, ltrb_box)
            tensors[f"{name}.f{i}.scores"], tensors[f"{name}.f{i}.ltrb"] = s, ltrb
            image = picture(i, h, w)
            run["frames"].append(tracker.update(i, image, s.astype(np.float64), ltrb))
        runs.append(short(run))
        print(name, [(x["flag"], x["updated"]) for x in run["frames"]])
    here = os.path.dirname(os.path.abspath(__file__))
    with open(os.path.join(here, "second_script.json"), "w") as file:
        file.write("[\n" + ",\n".join(json.dumps(run) for run in runs) + "\n]\n")
    head, body = {}, b""
    for name in sorted(tensors):
        data = tensors[name].astype("<f4").tobytes()
        head[name] = {
            "dtype": "F32",
            "shape": list(tensors[name].shape),
            "data_offsets": [len(body), len(body) + len(data)],
        }
        body += data
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 8)
    with open(os.path.join(here, "second_script.safetensors"), "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + body)


if __name__ == "__main__":
    main()
