#!/usr/bin/env bash
# Runs the unsafe code under Miri, which finds undefined behaviour that tests alone do not see: the
# scalar kernels with arena and threads (all other instruction sets share their source), the planner
# that lays the arena out, and the pool of the allocator. Each property is tried on few and small cases
# (`cfg(miri)`), Miri is slow: some minutes.
#
#   tests/miri/run.sh [--install] [FILTER..]
#
# --install fetches Miri through rustup. Exit code 0 passed, 77 not run because there is no Miri.
set -euo pipefail
cd "$(dirname "$0")/../.."
if [ "${1:-}" = --install ]; then
    shift
    rustup toolchain install nightly --profile minimal --component miri,rust-src || true
fi
if ! cargo +nightly miri --version >/dev/null 2>&1; then
    echo "skipped: no nightly toolchain with Miri; $0 --install fetches it when the machine is online" >&2
    exit 77
fi
filters=("$@")
[ $# -gt 0 ] || filters=(engine::native::kernels:: engine::native::plan:: engine::native::sync:: system::pool::)
# Without isolation: the property tests read their seed and the clock. The nightly compiler of the
# day may warn of what the pinned one does not.
export MIRIFLAGS="${MIRIFLAGS:-} -Zmiri-disable-isolation" RUSTFLAGS="${RUSTFLAGS:-} --cap-lints=warn"
for filter in "${filters[@]}"; do
    echo "== miri: $filter"
    # A pool keeps its memory for as long as the program runs; so do the pools of its tests.
    leaks=
    case $filter in system::*) leaks=-Zmiri-ignore-leaks ;; esac
    MIRIFLAGS="$MIRIFLAGS $leaks" \
        cargo +nightly miri test --locked -p tsda-runtime --features native,pool --lib "$filter"
done
