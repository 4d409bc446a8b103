#!/usr/bin/env bash
# Runs `tsda run` on the drawn scene at the highest rate with all outputs on and somebody at the preview,
# and checks that memory stays flat, the loop allocates nothing, and frames do not get slower.
#
#   tests/soak/run.sh [--frames N] [--json FILE] [--drift SHARE] [--dir FOLDER]
#
# Without --frames: two hours of video, 216,000 frames at 30 per second (half an hour on one free core).
# TSDA: the program; without it a release build is made. What is asserted stands in soak.py.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
if [ -z "${TSDA:-}" ]; then
  (cd "$root" && cargo build --release --locked --workspace --bin tsda)
  TSDA=${CARGO_TARGET_DIR:-$root/target}/release/tsda
fi
exec python3 "$here/soak.py" --program "$TSDA" "$@"
