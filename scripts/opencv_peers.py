#!/usr/bin/env python3
"""Tracks RGB-thermal sequences with the trackers of OpenCV, for comparison with ours.

    pip install opencv-contrib-python-headless
    python3 scripts/opencv_peers.py --sequences CLIPS --split val --protocol rgb2t --out out/peers \
        [--nanotrack DIR] [--tracker csrt ...]
    tsda eval --bundle models/nano.tsda --dataset sequences:CLIPS@val --protocol rgb2t --out out/nano
    tsda compare --dataset sequences:CLIPS@val --protocol rgb2t --results out/peers/csrt/rgb2t=CSRT \
        --results out/peers/nanotrack/rgb2t=NanoTrack --results out/nano/boxes/nano/rgb2t=nano

CLIPS is a folder with `index.json` and `<path>/{visible,infrared}/*.jpg`, `{visible,infrared}.txt`
(`tsda data-check sequences:CLIPS`). The protocols are those of `tsda eval`: rgb2t, t2rgb, switch:N,
rgb, t. A run starts at the first frame in which the target has a box in the first sensor. Every
frame goes in as three channels, thermal ones with three equal channels. A tracker that reports a
loss keeps its last box. CSRT and KCF stand in opencv-contrib; NanoTrack v2 needs its two ONNX files
(nanotrack_v2_backbone_255.onnx, nanotrack_v2_head.onnx) in the folder given with --nanotrack.

Prints the processor time per frame; writes DIR/<tracker>/<protocol>/<sequence>.txt, x,y,w,h.
"""

import argparse
import json
import os
import pathlib
import sys
import time

try:
    import cv2
except ImportError:
    sys.exit("opencv_peers: OpenCV is missing; run: pip install opencv-contrib-python-headless")

FOLDERS = {"rgb": "visible", "thermal": "infrared"}


def sensor_of(protocol, k):
    """Sensor of frame `k` of a run, as in tsda-eval's protocols."""
    if protocol in ("rgb", "t"):
        return "rgb" if protocol == "rgb" else "thermal"
    if protocol == "rgb2t":
        return "rgb" if k == 0 else "thermal"
    if protocol == "t2rgb":
        return "thermal" if k == 0 else "rgb"
    length = int(protocol.split(":")[1])
    if k == 0:
        return "rgb"
    return "thermal" if ((k - 1) // length) % 2 == 0 else "rgb"


def read_boxes(path):
    rows = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip():
            continue
        try:
            x, y, w, h = (float(v) for v in line.replace(",", " ").split())
        except ValueError:
            sys.exit(f"opencv_peers: {path}:{number}: expected four numbers x,y,w,h, found {line!r}")
        rows.append((x, y, w, h))
    return rows


def make(tracker, nanotrack):
    if tracker == "csrt":
        return cv2.TrackerCSRT_create()
    if tracker == "kcf":
        return cv2.TrackerKCF_create()
    if tracker == "mil":
        return cv2.TrackerMIL_create()
    params = cv2.TrackerNano_Params()
    params.backbone = str(nanotrack / "nanotrack_v2_backbone_255.onnx")
    params.neckhead = str(nanotrack / "nanotrack_v2_head.onnx")
    return cv2.TrackerNano_create(params)


def run(tracker, nanotrack, folder, protocol):
    """Boxes of one run, one per frame from the start of the run, and the seconds of processor time."""
    lists = {s: sorted((folder / d).glob("*.[jp][pn]g")) for s, d in FOLDERS.items() if (folder / d).is_dir()}
    truth = {s: read_boxes(folder / f"{FOLDERS[s]}.txt") for s in lists}
    first = sensor_of(protocol, 0)
    needed = {sensor_of(protocol, k) for k in range(len(truth.get(first, ())))}
    if not needed or not needed <= set(lists):
        return None
    length = min(len(lists[s]) for s in needed)
    start = next((k for k, b in enumerate(truth[first][:length]) if b[2] > 0 and b[3] > 0), None)
    if start is None:
        return None
    boxes, spent, box, t = [], 0.0, truth[first][start], None
    for k in range(start, length):
        path = lists[sensor_of(protocol, k - start)][k]
        frame = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if frame is None:
            sys.exit(f"opencv_peers: {path}: not a picture")
        before = time.process_time()
        if t is None:
            t = make(tracker, nanotrack)
            t.init(frame, tuple(int(round(v)) for v in box))
        else:
            ok, found = t.update(frame)
            if ok:
                box = tuple(float(v) for v in found)
            spent += time.process_time() - before
        boxes.append(box)
    return start, boxes, spent


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=pathlib.Path, required=True)
    parser.add_argument("--split", help="only this split of index.json")
    parser.add_argument("--protocol", action="append", required=True)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--tracker", action="append", choices=["csrt", "kcf", "mil", "nanotrack"])
    parser.add_argument("--nanotrack", type=pathlib.Path, help="folder of NanoTrack v2's two ONNX files")
    args = parser.parse_args()
    trackers = args.tracker or (["csrt", "kcf"] + (["nanotrack"] if args.nanotrack else []))
    if "nanotrack" in trackers and args.nanotrack is None:
        sys.exit("opencv_peers: --tracker nanotrack needs --nanotrack DIR with its ONNX files")
    for name in trackers:
        if name in ("csrt", "kcf") and not hasattr(cv2, f"Tracker{name.upper()}_create"):
            sys.exit(f"opencv_peers: this OpenCV has no {name}; run: pip install opencv-contrib-python-headless")
    cv2.setNumThreads(1)
    index = json.loads((args.sequences / "index.json").read_text())
    for protocol in args.protocol:
        for tracker in trackers:
            out = args.out / tracker / protocol.replace(":", "_")
            out.mkdir(parents=True, exist_ok=True)
            frames, seconds, sequences = 0, 0.0, 0
            for entry in index["sequences"]:
                if args.split and entry["split"] != args.split:
                    continue
                result = run(tracker, args.nanotrack, args.sequences / entry["path"], protocol)
                if result is None:
                    continue
                start, boxes, spent = result
                # Frames before the run are not tracked; the row stands for "no box".
                rows = [(0, 0, 0, 0)] * start + boxes
                target = out / f"{entry['name']}.txt"
                part = target.with_suffix(".part")
                part.write_text("".join(",".join(f"{v:.3f}" for v in row) + "\n" for row in rows))
                os.replace(part, target)
                frames, seconds, sequences = frames + len(boxes) - 1, seconds + spent, sequences + 1
            cost = f"{1e3 * seconds / frames:.1f} ms of processor time per frame" if frames else "nothing tracked"
            print(f"{tracker} {protocol}: {sequences} sequences, {frames} frames, {cost}", flush=True)


if __name__ == "__main__":
    main()
