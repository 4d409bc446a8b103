#!/usr/bin/env bash
# Counts the system calls of 200 frames on the native engine with 1 and 2 threads, under strace.
# The test is part of `cargo test`; this runs it alone, and fetches strace with --install.
set -euo pipefail
cd "$(dirname "$0")/../.."
if [ "${1:-}" = --install ] && ! command -v strace >/dev/null; then
    apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq strace >/dev/null || true
fi
command -v strace >/dev/null || echo "skipped: no strace; $0 --install fetches it when the machine is online" >&2
exec cargo test --locked -p tsda-runtime --features native --test native_syscalls
