#!/usr/bin/env bash
# Fetches the ONNX Runtime shared library out of its PyPI wheel, for this machine's processor.
#
#     eval "$(scripts/fetch_onnxruntime.sh)"               # into target/onnxruntime
#     eval "$(scripts/fetch_onnxruntime.sh --gpu DIR)"     # with CUDA and TensorRT providers, into DIR
#     scripts/fetch_onnxruntime.sh --version 1.22.0 DIR
#
# Standard output is one line, `export TSDA_ORT_LIB=...`; everything else goes to standard error. A
# library that is already in DIR is kept. The GPU wheel holds no CUDA, cuDNN or TensorRT: those have
# to be on the machine. Exit codes: 0 done, 1 the wheel cannot be had, 2 wrong arguments.
set -euo pipefail

say() { echo "fetch_onnxruntime: $*" >&2; }

package=onnxruntime
version=""
dir=""
while [ $# -gt 0 ]; do
  case "$1" in
    --gpu) package=onnxruntime-gpu ;;
    --version)
      [ $# -ge 2 ] || { say "--version needs a number, such as 1.22.0"; exit 2; }
      version="$2"
      shift
      ;;
    -h | --help) sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p;}' "$0"; exit 0 ;;
    -*) say "unknown option $1; possible: --gpu, --version N"; exit 2 ;;
    *)
      [ -z "$dir" ] || { say "one folder only, not '$dir' and '$1'"; exit 2; }
      dir="$1"
      ;;
  esac
  shift
done
if [ -z "$dir" ]; then
  dir="${CARGO_TARGET_DIR:-$(cd "$(dirname "$0")/.." && pwd)/target}/$package${version:+-$version}"
fi

library() { find "$dir" -maxdepth 1 -name 'libonnxruntime.so.[0-9]*' 2>/dev/null | sort | tail -n 1; }
answer() {
  local found
  found="$(cd "$dir" && pwd)/$(basename "$(library)")"
  printf 'export TSDA_ORT_LIB=%q\n' "$found"
}

# The CPU wheel has no CUDA provider: a folder filled by it does not serve --gpu.
if [ -n "$(library)" ]; then
  if [ "$package" = onnxruntime-gpu ] && [ ! -e "$dir/libonnxruntime_providers_cuda.so" ]; then
    say "$dir holds the CPU library; name another folder for --gpu"
    exit 2
  fi
  if [ -n "$version" ] && [ ! -e "$dir/libonnxruntime.so.$version" ]; then
    say "$dir holds $(basename "$(library)"), not $version; name another folder"
    exit 2
  fi
  answer
  exit 0
fi

python="${TSDA_PYTHON:-python3}"
command -v "$python" >/dev/null || { say "$python not found: install Python 3, or set TSDA_PYTHON"; exit 1; }
"$python" -m pip --version >/dev/null 2>&1 || { say "$python has no pip: install it (python3-pip), or set TSDA_PYTHON to a Python that has"; exit 1; }

mkdir -p "$dir"
work="$(mktemp -d "$dir/fetch.XXXXXX")"
trap 'rm -rf "$work"; rmdir "$dir" 2>/dev/null || true' EXIT
say "downloading $package${version:+ $version} for $(uname -m)"
if ! "$python" -m pip download --quiet --no-deps --only-binary=:all: --dest "$work" \
  "$package${version:+==$version}" >&2; then
  say "pip could not download $package${version:+ $version}: is the machine offline, or is there no wheel for $(uname -m) and $("$python" --version)?"
  exit 1
fi

# Only the libraries, in one flat folder: they look for each other beside themselves.
"$python" - "$work" <<'PY'
import pathlib, sys, zipfile

work = pathlib.Path(sys.argv[1])
(wheel,) = work.glob("*.whl")
with zipfile.ZipFile(wheel) as archive:
    for name in archive.namelist():
        file = name.rsplit("/", 1)[-1]
        if "/capi/" in name and file.startswith("libonnxruntime") and ".so" in file:
            (work / file).write_bytes(archive.read(name))
wheel.unlink()
PY
if ! compgen -G "$work/libonnxruntime.so.*" >/dev/null; then
  say "the wheel holds no libonnxruntime.so: ask for a newer one with --version"
  exit 1
fi
# The library itself comes last: it is what makes the folder count as filled.
find "$work" -name 'libonnxruntime_*' -exec mv -f {} "$dir/" \;
find "$work" -name 'libonnxruntime.so.*' -exec mv -f {} "$dir/" \;
answer
