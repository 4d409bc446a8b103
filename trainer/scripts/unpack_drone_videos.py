#!/usr/bin/env python3
"""Unpack the drone-detection clips (mp4 and one box per frame) into folders the trainer reads.

    pip install opencv-python-headless
    python3 trainer/scripts/unpack_drone_videos.py SOURCE DESTINATION [--stride 4] [--max-side 640]

SOURCE holds `IR_*.mp4` (thermal) and `V_*.mp4` (RGB) with `labels/NAME.txt`, one `x,y,w,h` per frame,
`NaN` where the target is absent: a subset of the Drone-detection-dataset (CC0-1.0). DESTINATION gets
what the dataset kind `sequences` reads:

    index.json                                  names, splits, sensors
    <NAME>/infrared/000001.jpg, infrared.txt    or visible/, visible.txt

Every `--stride`-th frame is kept. Frames larger than `--max-side` are made smaller, and their boxes
with them. The validation split is made of whole blocks of clip numbers, since neighbouring numbers
often show one background: see VALIDATION, and `--validation` to change it.

May be run again: clips that are there, made with the same settings, stay as they are. A clip is
written under a temporary name and renamed when it is whole, `index.json` last.
Exit codes: 0 done, 1 some clips could not be read, 2 could not.
"""

import argparse
import json
import os
import re
import shutil
import sys

# Blocks of clip numbers to validate on, both ends included.
VALIDATION = (
    "IR_DRONE:92-128,IR_HELICOPTER:36-45,IR_AIRPLANE:60-71,IR_BIRD:64-76,"
    "V_DRONE:66-86,V_HELICOPTER:36-45,V_AIRPLANE:46-54"
)
SENSORS = {"IR": "infrared", "V": "visible"}
NAME = re.compile(r"^((IR|V)_[A-Z]+)_(\d+)$")


class Failed(Exception):
    """What to tell the user."""


def import_cv2():
    """OpenCV, or a message that says how to get it."""
    try:
        import cv2
    except ImportError as error:
        raise Failed(
            f"OpenCV for Python is needed to decode videos ({error}): "
            "python3 -m pip install opencv-python-headless"
        ) from error
    return cv2


def read_blocks(text):
    """`CLASS:FIRST-LAST,..` as {class: [(first, last)]}."""
    blocks = {}
    for part in filter(None, text.split(",")):
        found = re.fullmatch(r"((?:IR|V)_[A-Z]+):(\d+)-(\d+)", part.strip())
        if not found:
            raise Failed(f"--validation: '{part}' is not of the form IR_DRONE:92-128")
        blocks.setdefault(found[1], []).append((int(found[2]), int(found[3])))
    return blocks


def read_boxes(path):
    """One box per line, None where the target is absent."""
    boxes = []
    with open(path, encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            if not line.strip():
                continue
            try:
                box = [float(field) for field in line.split(",")]
            except ValueError as error:
                raise Failed(f"{path}, line {number}: {error}") from error
            if len(box) != 4:
                raise Failed(f"{path}, line {number}: {len(box)} numbers, a box has 4")
            # NaN compares as false.
            boxes.append(box if box[2] > 0 and box[3] > 0 else None)
    return boxes


def write_atomic(path, text):
    """Writes a text file under a temporary name and renames it."""
    with open(path + ".part", "w", encoding="utf-8") as file:
        file.write(text)
    os.replace(path + ".part", path)


def unpack(cv2, video, labels, folder, sensor, options):
    """Writes one clip to `folder`; returns what index.json says about it."""
    boxes = read_boxes(labels)
    capture = cv2.VideoCapture(video)
    if not capture.isOpened():
        raise Failed(f"{video}: cannot be opened as a video")
    part = folder + ".part"
    shutil.rmtree(part, ignore_errors=True)
    os.makedirs(os.path.join(part, sensor))
    rows, frame, size = [], 0, None
    # Where annotation and video differ in length, what both have is kept.
    while frame < len(boxes) and capture.grab():
        if frame % options.stride == 0:
            ok, picture = capture.retrieve()
            if not ok:
                raise Failed(f"{video}: frame {frame} cannot be decoded")
            height, width = picture.shape[:2]
            scale = min(1.0, options.max_side / max(width, height))
            if scale < 1.0:
                size = (round(width * scale), round(height * scale))
                picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            size = (picture.shape[1], picture.shape[0])
            if sensor == "infrared":
                picture = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            path = os.path.join(part, sensor, f"{len(rows) + 1:06}.jpg")
            if not cv2.imwrite(path, picture, [cv2.IMWRITE_JPEG_QUALITY, options.quality]):
                raise Failed(f"{path}: cannot be written")
            fx, fy = size[0] / width, size[1] / height
            x, y, w, h = boxes[frame] or (0, 0, 0, 0)
            rows.append(f"{x * fx:.2f},{y * fy:.2f},{w * fx:.2f},{h * fy:.2f}")
        frame += 1
    capture.release()
    if not rows:
        raise Failed(f"{video}: no frame could be decoded")
    write_atomic(os.path.join(part, f"{sensor}.txt"), "\n".join(rows) + "\n")
    entry = {
        "frames": len(rows),
        "absent": sum(row == "0.00,0.00,0.00,0.00" for row in rows),
        "modalities": [sensor],
        "width": size[0],
        "height": size[1],
    }
    meta = {"settings": settings(options), "entry": entry}
    write_atomic(os.path.join(part, "meta.json"), json.dumps(meta, indent=1) + "\n")
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)
    return entry


def settings(options):
    """What makes a clip that is there already another one."""
    return {"stride": options.stride, "max_side": options.max_side, "quality": options.quality}


def unpacked(folder, options):
    """What is known about a clip that was unpacked before with these settings."""
    try:
        with open(os.path.join(folder, "meta.json"), encoding="utf-8") as file:
            meta = json.load(file)
        return meta["entry"] if meta["settings"] == settings(options) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def run(options):
    """Unpacks all clips; returns how many could not be."""
    blocks = read_blocks(options.validation)
    if not os.path.isdir(options.source):
        raise Failed(f"{options.source} is not a folder")
    names = sorted(n[:-4] for n in os.listdir(options.source) if n.lower().endswith(".mp4"))
    clips = [(name, NAME.match(name)) for name in names]
    clips = [(name, found) for name, found in clips if found]
    if not clips:
        raise Failed(f"{options.source}: no IR_*_NNN.mp4 or V_*_NNN.mp4 in it")
    cv2 = import_cv2()
    os.makedirs(options.destination, exist_ok=True)
    sequences, failed, fresh = [], 0, 0
    for at, (name, found) in enumerate(clips, 1):
        group, sensor, number = found[1], SENSORS[found[2]], int(found[3])
        folder = os.path.join(options.destination, name)
        entry = unpacked(folder, options)
        if entry is None:
            video = os.path.join(options.source, f"{name}.mp4")
            labels = os.path.join(options.source, "labels", f"{name}.txt")
            try:
                entry = unpack(cv2, video, labels, folder, sensor, options)
                fresh += 1
            except (Failed, OSError) as error:
                shutil.rmtree(folder + ".part", ignore_errors=True)
                print(f"{name}: left out: {error}", file=sys.stderr)
                failed += 1
                continue
        held_out = any(a <= number <= b for a, b in blocks.get(group, []))
        split = "val" if held_out else "train"
        sequences.append({"name": name, "path": name, "split": split, "licence": "CC0-1.0", **entry})
        if at % 50 == 0:
            print(f"{at} of {len(clips)} clips")
    if not sequences:
        raise Failed("none of the clips could be unpacked")
    index = {"version": 1, "sequences": sequences}
    path = os.path.join(options.destination, "index.json")
    write_atomic(path, json.dumps(index, indent=1) + "\n")
    of = {split: sum(s["split"] == split for s in sequences) for split in ("train", "val")}
    frames = sum(s["frames"] for s in sequences)
    print(
        f"{options.destination}: {of['train']} clips to train on, {of['val']} to validate on, "
        f"{frames} frames; {fresh} unpacked now, {failed} left out"
    )
    return failed


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("source", help="folder of the mp4 files and labels/")
    parser.add_argument("destination", help="folder to write")
    parser.add_argument("--stride", type=int, default=4, help="keep every n-th frame")
    parser.add_argument("--max-side", type=int, default=640, help="largest side in pixels")
    parser.add_argument("--quality", type=int, default=92, help="JPEG quality, 1 to 100")
    parser.add_argument("--validation", default=VALIDATION, help="blocks CLASS:FIRST-LAST,..")
    options = parser.parse_args()
    try:
        if options.stride < 1 or options.max_side < 16 or not 1 <= options.quality <= 100:
            raise Failed("--stride must be at least 1, --max-side 16, --quality from 1 to 100")
        return 1 if run(options) else 0
    except (Failed, OSError) as error:
        print(f"unpack_drone_videos: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
