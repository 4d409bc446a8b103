#!/bin/bash
# `tsda run` on real V4L2 drivers without hardware: user-mode Linux with vivid,
# v4l2loopback, and a USB thermal camera played to the real uvcvideo.
#
#   tests/v4l2/run.sh [--require] [TEST...]      TESTs: vivid faults loopback uvc pair
#
# Without --require it says why and ends with 0 where it cannot run (not root, no packages), and where
# the kernel is not in the cache yet: building it takes minutes. TSDA_V4L2=1 builds it (CI does),
# TSDA_V4L2=0 leaves the tests out.
# It always ends: after TSDA_V4L2_LIMIT seconds (2400) what has not begun is left out, and said to be;
# KERNEL_LIMIT (1500) of these are for the kernel, LIMIT (600) for each run of a test, which fails then.
# A test that fails is run a second time, and the first failure stays in the log.
# TSDA and PROBE may name programs that are already built; TSDA needs the feature `camera`.
# QEMU_V4L2_CACHE is where kernels are kept (vm.sh --help).
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
require= tests=()
for a; do
  case $a in
    --require) require=y ;;
    -*) sed -n '2,/^set -/{/^set -/d;s/^# \{0,1\}//p}' "$0"; exit 2 ;;
    *) tests+=("$a") ;;
  esac
done
[ ${#tests[@]} -gt 0 ] || tests=(vivid faults loopback uvc pair)

limit=${TSDA_V4L2_LIMIT:-2400}
# within SECONDS COMMAND...: ends it, and all it has started, when its time or that of all is over
within() {
  local left=$((limit - SECONDS)) most=$1; shift
  [ "$left" -lt "$most" ] || left=$most
  [ "$left" -gt 0 ] || return 124
  timeout --kill-after=20 "$left" "$@"
}
skip() {
  [ -z "$require" ] || { echo "cannot run: $1" >&2; exit 1; }
  echo "skipped: V4L2 tests: $1"
  exit 0
}
[ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] || skip "the virtual machine is for x86-64 Linux"
command -v apt-get >/dev/null || skip "kernels come from Debian packages, and there is no apt-get"
[ -n "$require" ] || [ "${TSDA_V4L2:-}" != 0 ] || skip "TSDA_V4L2=0"
cache=${QEMU_V4L2_CACHE:-$HOME/.cache/qemu-v4l2-test}
if [ ! -e "$cache/uml/.done" ]; then
  [ -n "$require" ] || [ "${TSDA_V4L2:-}" = 1 ] ||
    skip "no kernel in $cache yet; TSDA_V4L2=1 builds it once (5 to 25 minutes)"
  [ "$(id -u)" = 0 ] || skip "needs root to install what builds the kernel"
fi
# What reads the kernel's headers when tsda is built with cameras.
has_clang() {
  [ -n "${LIBCLANG_PATH:-}${TSDA:-}" ] || ls /usr/lib/llvm-*/lib/libclang*.so* >/dev/null 2>&1 ||
    ldconfig -p 2>/dev/null | grep -q libclang
}
install_clang() {
  apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 install -y \
    --no-install-recommends libclang1 linux-libc-dev
}
export -f install_clang
has_clang || { [ "$(id -u)" = 0 ] && within 600 bash -c install_clang >/dev/null 2>&1; } || true
has_clang || skip "no libclang, which building with cameras needs (apt-get install libclang1)"
log=$(mktemp -d)
trap 'rm -rf "$log"' EXIT
rc=0
within "${KERNEL_LIMIT:-1500}" "$here/vm.sh" --vivid --loopback=2 --uvc --prepare >"$log/prepare" 2>&1 || rc=$?
[ $rc != 124 ] || skip "the kernel was not built in time (KERNEL_LIMIT, TSDA_V4L2_LIMIT): this machine is too busy"
[ $rc = 0 ] || skip "no kernel: $(tail -1 "$log/prepare")"
echo "V4L2 tests: kernel there after $SECONDS s"

# Without the other engines: a build of few crates, of which the tests before have made most.
if [ -z "${TSDA:-}" ]; then
  rc=0
  (cd "$root" && within 1500 cargo build --locked -p tsda-host --no-default-features --features embed,camera) || rc=$?
  [ $rc != 124 ] || skip "tsda with cameras was not built in time: this machine is too busy"
  [ $rc = 0 ] || { echo "tsda does not build with cameras" >&2; exit 1; }
  # Other builds may put theirs in its place meanwhile.
  cp "${CARGO_TARGET_DIR:-$root/target}/debug/tsda" "$log/tsda"
  TSDA=$log/tsda
fi
if [ -z "${PROBE:-}" ]; then
  (cd "$here/probe" && CARGO_TARGET_DIR=$log/probe within 600 cargo build --locked --quiet) ||
    { echo "the camera player does not build" >&2; exit 1; }
  PROBE=$log/probe/debug/v4l2probe
fi
echo "V4L2 tests: programs there after $SECONDS s"
"$TSDA" render --out "$log/clip" --raw --frames 96

failed=() left_out=()
for t in "${tests[@]}"; do
  case $t in
    vivid | faults) devices=(--vivid) ;;
    loopback) devices=(--loopback=2) ;;
    uvc | pair) devices=(--uvc) ;;
    *) echo "no test $t" >&2; exit 2 ;;
  esac
  if [ $SECONDS -ge "$limit" ]; then
    left_out+=("$t")
    continue
  fi
  # A machine busy with other things can stop the virtual one for seconds; what fails twice is broken.
  for attempt in 1 2; do
    echo "== $t"
    rc=0
    within $((${LIMIT:-600} + 60)) "$here/vm.sh" "${devices[@]}" --timeout "${LIMIT:-600}" --mem 768 \
      --out "$log/out-$t-$attempt" --add "$PROBE:/bin/probe" --add "$log/clip:/data/clip" \
      --add "$here/lib.sh:/data/lib.sh" --sh "$here/t-$t.sh" "$TSDA" || rc=$?
    [ $rc != 0 ] || { echo "== $t: ok, after $SECONDS s"; break; }
    # 124 once the time of all is over: the test did not fail, it did not finish.
    [ $attempt = 2 ] || [ $rc != 124 ] || [ $SECONDS -lt "$limit" ] || { left_out+=("$t"); break; }
    echo "== $t: FAILED ($rc)"
    tail -5 "$log/out-$t-$attempt"/*.err 2>/dev/null || true
    [ $attempt = 1 ] || { failed+=("$t"); break; }
    echo "== $t: once more, to tell a fault from a busy machine"
  done
done
[ ${#left_out[@]} -eq 0 ] || echo "skipped: V4L2 tests: ${left_out[*]}: the $limit seconds are over"
[ ${#failed[@]} -eq 0 ] || { echo "failed: ${failed[*]}"; exit 1; }
