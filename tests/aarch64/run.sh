#!/usr/bin/env bash
# Builds runtime and host for aarch64 and runs, under emulation: the runtime's tests (every kernel,
# NEON among them, against loops written out; bundles against their probe; the tracker) and
# `tsda verify`, the parity check of the native engine on the shipped model.
#
#   tests/aarch64/run.sh [--install] [--all]
#
# --install fetches what is missing (Rust target through rustup, cross compiler and emulator through
# apt). --all adds tract to the host and to the comparison (compiles for a quarter of an hour).
# Exit code 0 passed, 1 failed, 77 not run because something is missing.
set -euo pipefail
cd "$(dirname "$0")/../.."
target=aarch64-unknown-linux-gnu
install= features=(--no-default-features --features embed)
for argument in "$@"; do
    case $argument in
    --install) install=1 ;;
    --all) features=(--no-default-features --features embed,tract) ;;
    *) echo "tests/aarch64/run.sh: unknown argument $argument" >&2 && exit 2 ;;
    esac
done

missing() {
    echo "skipped: $1; $0 --install fetches it when the machine is online" >&2
    exit 77
}
has_target() { [ -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; }
if [ -n "$install" ]; then
    has_target || rustup target add "$target" || missing "rustup has no $target"
    if ! command -v aarch64-linux-gnu-gcc >/dev/null || ! command -v qemu-aarch64 >/dev/null; then
        apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq \
            gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user >/dev/null ||
            missing "apt has no cross compiler or emulator"
    fi
fi
has_target || missing "the Rust target $target is not installed"
command -v aarch64-linux-gnu-gcc >/dev/null || missing "no aarch64-linux-gnu-gcc"
command -v qemu-aarch64 >/dev/null || missing "no qemu-aarch64 (Debian: qemu-user)"

export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64 -L /usr/aarch64-linux-gnu"
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-target}
echo "== runtime: unit tests, kernels, bundles, allocations"
# Not `native_allocation`: a thousand frames take too long here, and the code is the same.
cargo test --locked -p tsda-runtime --features native --target "$target" \
    --lib --test native_bundles --test no_allocation
echo "== host: parity of the engines on the shipped model"
cargo build --locked -p tsda-host "${features[@]}" --target "$target"
tsda="$CARGO_TARGET_DIR/$target/debug/tsda"
for engine in native native,threads=2 native,isa=scalar; do
    $CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER "$tsda" verify --no-times --engine "$engine"
done
[ "${features[2]}" = embed ] || $CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER "$tsda" verify --no-times
echo "aarch64: passed"
