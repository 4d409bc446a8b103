#!/usr/bin/env bash
# Runs every test of the workspace. Where Python is found, the packages that check our ONNX files
# and recordings from outside (onnx, onnxruntime, mcap and others) are installed once into target/py,
# and the ONNX Runtime library among them serves the tests of our own ONNX Runtime engine; without
# Python or network the tests that need them say "skipped" and the rest runs all the same.
set -euo pipefail
cd "$(dirname "$0")/.."

target="${CARGO_TARGET_DIR:-target}"
venv="$target/py"
want="onnx>=1.17 onnxruntime>=1.20 numpy pillow mcap>=1.6 jsonschema foxglove-schemas-protobuf pybag-sdk"

prepare_python() {
  command -v python3 >/dev/null || { echo "python3 not found: the checks from Python are skipped"; return 1; }
  if [ -x "$venv/bin/python" ] && "$venv/bin/python" -c 'import onnx, onnxruntime, numpy, PIL, mcap, jsonschema, foxglove_schemas_protobuf, pybag' 2>/dev/null; then
    return 0
  fi
  mkdir -p "$target"
  rm -rf "$venv"
  python3 -m venv "$venv" >/dev/null 2>&1 || { echo "python3 has no venv module: the ONNX checks from Python are skipped"; return 1; }
  # shellcheck disable=SC2086
  "$venv/bin/python" -m pip install --quiet $want || { echo "pip could not install '$want' (offline?): the ONNX checks from Python are skipped"; rm -rf "$venv"; return 1; }
}

if prepare_python; then
  TSDA_PYTHON="$(cd "$(dirname "$venv")" && pwd)/py/bin/python"
  export TSDA_PYTHON
  if [ -z "${TSDA_ORT_LIB:-}" ]; then
    TSDA_ORT_LIB="$(find "$venv/lib" -path '*/onnxruntime/capi/libonnxruntime.so.*' | sort | tail -n 1)"
    if [ -n "$TSDA_ORT_LIB" ]; then
      TSDA_ORT_LIB="$(cd "$(dirname "$TSDA_ORT_LIB")" && pwd)/$(basename "$TSDA_ORT_LIB")"
      export TSDA_ORT_LIB
    fi
  fi
fi

log="$target/test.log"
mkdir -p "$target"
status=0
# --show-output: the measured figures (parity, allocations, reference cases) are worth reading.
cargo test --workspace --locked "$@" -- --show-output 2>&1 | tee "$log" || status=$?

# Cameras on the kernel's own test drivers, in a virtual machine; says why where it cannot run.
if [ $# = 0 ]; then
  tests/v4l2/run.sh || status=$?
fi

# cargo closes with the documentation tests of the last crate; this is the sum over all of them.
awk '/^test result:/ { passed += $4; failed += $6; ignored += $8 }
     END { printf "%d passed, %d failed, %d skipped\n", passed, failed, ignored }' "$log"
exit "$status"
