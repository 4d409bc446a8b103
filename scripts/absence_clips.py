#!/usr/bin/env python3
"""Makes clips with an absence out of real ones that have none: the target is painted out for a while.

    pip install numpy opencv-python-headless
    python3 scripts/absence_clips.py FOLDER/clip .. --out CLIPS
    tsda presence --dataset sequences:CLIPS --protocol t --scan-when-lost

Each FOLDER/clip holds `infrared/` pictures and `infrared.txt`, one `x,y,w,h` per frame. It is played
forward and back, up to --frames; from a quarter of that on, for --absent of it (60 frames at least),
the box and a margin of a fifth are filled in from their surroundings and the row is `0,0,0,0`. Whatever
else is in the picture stays: other people do.
"""

import argparse
import pathlib
import sys

import cv2
import numpy as np


def painted_out(picture, box):
    x, y, w, h = box
    mask = np.zeros(picture.shape, np.uint8)
    left, top = max(0, int(x - 0.2 * w - 2)), max(0, int(y - 0.2 * h - 2))
    mask[top : int(y + 1.2 * h + 3), left : int(x + 1.2 * w + 3)] = 255
    return cv2.inpaint(picture, mask, 4, cv2.INPAINT_TELEA)


def make(clip, out, args):
    lines = (clip / "infrared.txt").read_text().replace("\t", ",").split("\n")
    rows = [[float(v) for v in line.replace(" ", ",").split(",")] for line in lines if line.strip()]
    files = sorted((clip / "infrared").iterdir())
    if len(files) < len(rows):
        sys.exit(f"{clip}: {len(files)} pictures, but {len(rows)} boxes in infrared.txt")
    order = (list(range(len(rows))) + list(range(len(rows) - 2, -1, -1)))[: args.frames]
    gone = len(order) // 4
    back = gone + max(60, int(len(order) * args.absent))
    (out / "infrared").mkdir(parents=True, exist_ok=True)
    text = []
    for k, i in enumerate(order):
        picture = cv2.imread(str(files[i]), cv2.IMREAD_GRAYSCALE)
        if picture is None:
            sys.exit(f"{files[i]}: not a picture")
        box = rows[i]
        if gone <= k < back:
            picture, box = painted_out(picture, box), [0, 0, 0, 0]
        cv2.imwrite(str(out / "infrared" / f"{k + 1:06}.png"), picture)
        text.append(",".join(f"{v:g}" for v in box))
    (out / "infrared.txt").write_text("\n".join(text) + "\n")
    print(f"{out}: {len(order)} frames, absent in {gone}..{back - 1}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("clips", nargs="+", type=pathlib.Path)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--frames", type=int, default=220)
    parser.add_argument("--absent", type=float, default=0.45)
    args = parser.parse_args()
    for clip in args.clips:
        make(clip, args.out / clip.name, args)


if __name__ == "__main__":
    main()
