#!/usr/bin/env bash
# Size and crates of the program with the native engine alone.
#
#   scripts/lean.sh [--no-build]
#
# Builds `tsda` with `--release --no-default-features` (no tract, no ONNX Runtime, no evaluation, no
# embedded model, no progress bars), strips a copy and prints its bytes. Then counts, for this
# platform, the different packages (name and version) that Cargo compiles for it, our own two
# included:
#   linked    what ends up in the program: normal dependencies without procedural macros
#   tree      the same with procedural macros and what those need: `cargo tree --edges normal`
# Development dependencies (tests) and build scripts' dependencies (`build`) are printed for
# comparison. Exit code 1 when a goal is missed: below 6,000,000 bytes, below 60 crates in the tree.
set -euo pipefail
cd "$(dirname "$0")/.."
lean=(-p tsda-host --no-default-features --locked)
target=$(rustc -vV | sed -n 's/^host: //p')
crates() {
    cargo tree "${lean[@]}" --target "$target" --prefix none --edges "$1" |
        sed -e 's/ (\*)$//' -e 's/ (proc-macro)//' | awk 'NF { print $1, $2 }' | sort -u | wc -l
}
tree=$(crates normal)
printf 'crates linked            %9d\ncrates in the tree       %9d  (below 60)\n' \
    "$(crates normal,no-proc-macro)" "$tree"
printf 'with build dependencies  %9d\nwith tests               %9d\n' \
    "$(crates normal,build)" "$(crates normal,build,dev)"
size=0
if [ "${1:-}" != --no-build ]; then
    cargo build "${lean[@]}" --release --bin tsda
    copy=$(mktemp)
    trap 'rm -f "$copy"' EXIT
    strip -o "$copy" "${CARGO_TARGET_DIR:-target}/release/tsda"
    size=$(stat -c %s "$copy")
    printf 'stripped program         %9d  bytes (below 6000000)\n' "$size"
fi
[ "$tree" -lt 60 ] && [ "$size" -lt 6000000 ]
