#!/usr/bin/env bash
# Runs `tsda run` on the drawn scene at the highest rate with all outputs, and checks that memory
# stays flat and frames do not get slower.
#
#   tests/soak/run.sh [SECONDS]        two hours without an argument
#
# TSDA: the program; without it a release build is made. SOAK_DRIFT: by how much (share) the mean
# time of a frame may grow from the second to the last quarter, default 0.15; more on a machine that
# does other work. SOAK_DIR: where samples and recordings go (a temporary folder without it).
set -euo pipefail
cd "$(dirname "$0")/../.."

seconds=${1:-7200}
drift=${SOAK_DRIFT:-0.15}
samples=60
if [[ -z ${TSDA:-} ]]; then
    cargo build --release --bin tsda
    TSDA=${CARGO_TARGET_DIR:-target}/release/tsda
fi
if [[ -n ${SOAK_DIR:-} ]]; then
    dir=$SOAK_DIR
    mkdir -p "$dir"
else
    dir=$(mktemp -d)
    trap 'rm -rf "$dir"' EXIT
fi

cat >"$dir/host.toml" <<'TOML'
clock = "frames"
[[source]]
name = "rgb"
sensor = "rgb"
render = { frames = 48, repeat = true }
[[source]]
name = "thermal"
sensor = "thermal"
profile = "lepton"
render = { size = [160, 120], frames = 48, raw16 = true, repeat = true }
[switch]
every_s = 7.0
[[output.json]]
to = "udp:127.0.0.1:9"
[output.preview]
bind = "127.0.0.1:0"
[output.metrics]
bind = "127.0.0.1:0"
[output.mavlink]
to = "udp:127.0.0.1:14550"
[output.mcap]
dir = "recording"
file_mb = 16
total_mb = 64
[process.temperature]
TOML

"$TSDA" run --config "$dir/host.toml" 2>"$dir/log" &
pid=$!
trap 'kill "$pid" 2>/dev/null || true; [[ -n ${SOAK_DIR:-} ]] || rm -rf "$dir"' EXIT

port_of() { sed -n "s|.*$1 at http://127.0.0.1:\([0-9]*\).*|\1|p" "$dir/log" | head -1; }
get() { # port path; the answer on standard output
    exec 3<>"/dev/tcp/127.0.0.1/$1"
    printf 'GET %s HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n' "$2" >&3
    cat <&3
    exec 3>&-
}

# Drawing the scene takes its time.
until grep -q 'frame 0: started' "$dir/log"; do
    kill -0 "$pid" 2>/dev/null || { cat "$dir/log"; exit 1; }
    sleep 0.2
done
metrics=$(port_of metrics)
preview=$(port_of preview)

start=$SECONDS
: >"$dir/samples"
for i in $(seq "$samples"); do
    while ((SECONDS - start < i * seconds / samples)); do
        sleep 1
        # Somebody looks.
        get "$preview" '/picture?source=0' >"$dir/picture"
    done
    kill -0 "$pid" 2>/dev/null || { echo "FAILED: it ended early"; cat "$dir/log"; exit 1; }
    get "$metrics" /metrics | tr -d '\r' | awk -v t="$((SECONDS - start))" '
        /^tsda_frames_total/ { frames += $2 }
        /^tsda_latency_seconds_sum/ { sum = $2 }
        /^tsda_latency_seconds_count/ { count = $2 }
        /^tsda_latency_recent_seconds\{quantile="0.99"/ { p99 = $2 }
        /^tsda_output_dropped_total/ { dropped += $NF }
        /^process_resident_memory_bytes/ { rss = $2 }
        END { print t, frames, sum, count, p99, rss, dropped }' >>"$dir/samples"
done
threads=$(ls "/proc/$pid/task" | wc -l)
files=$(ls "/proc/$pid/fd" | wc -l)
kill "$pid"
code=0
wait "$pid" || code=$?

awk -v limit="$drift" -v code="$code" -v threads="$threads" -v files="$files" '
    { t[NR] = $1; frames[NR] = $2; sum[NR] = $3; count[NR] = $4; rss[NR] = $6; dropped = $7
      if ($5 > p99) p99 = $5 }
    function mean(a, b) { return (sum[b] - sum[a]) / (count[b] - count[a]) }
    function peak(a, b,   i, m) { for (i = a; i <= b; i++) if (rss[i] > m) m = rss[i]; return m }
    END {
        q = int(NR / 4); early = mean(q, 2 * q); late = mean(3 * q, NR)
        before = peak(q, 2 * q); after = peak(3 * q, NR)
        printf "%d s, %d frames, %.1f frames/s, %d threads, %d files\n", t[NR], frames[NR], \
            frames[NR] / t[NR], threads, files
        printf "latency: mean %.2f ms early, %.2f ms late (%+.1f %%); largest p99 of 1024 frames %.2f ms\n", \
            early * 1e3, late * 1e3, (late / early - 1) * 100, p99 * 1e3
        printf "memory: %.1f MB early, %.1f MB late; %d items dropped by outputs\n", before / 1e6, after / 1e6, dropped
        if (code != 0) { print "FAILED: exit code " code; bad = 1 }
        # Chunks of the recording fill faster when frames do: a few megabytes either way. A leak of 10
        # bytes per frame shows within two hours; short runs say less.
        if (after > before * 1.02 + 4e6) { print "FAILED: memory grows"; bad = 1 }
        if (late > early * (1 + limit)) { print "FAILED: frames get slower"; bad = 1 }
        if (frames[NR] <= frames[NR - 1]) { print "FAILED: it stands still"; bad = 1 }
        exit bad
    }' "$dir/samples"
grep -a '^tsda: signal' "$dir/log" || { echo "FAILED: no summary"; cat "$dir/log"; exit 1; }
