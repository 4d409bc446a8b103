# For the scripts in the virtual machine (busybox sh): $BIN is tsda, /bin/probe plays cameras.
bad=0
fail() { echo "FAIL: $*"; bad=$((bad + 1)); }
ok() { echo "ok: $*"; }

# config NAME DEVICE FORMAT WxH [more keys of v4l2]: a configuration with one camera
config() {
  profile=
  [ -z "${PROFILE:-}" ] || profile="profile = \"$PROFILE\""
  cat >/tmp/$1.toml <<C
give_up_s = 8
[[source]]
name = "cam"
sensor = "${SENSOR:-rgb}"
$profile
v4l2 = { device = "$2", format = "$3", size = [${4%x*}, ${4#*x}]${5:+, $5} }
[target]
box = [${BOX:-40, 30, 40, 40}]
[control]
socket = "/tmp/$1.sock"
[[output.json]]
to = "stdout"
queue = 4096
C
}
# run NAME [ARG...]: leaves /out/NAME.jsonl and /out/NAME.err, answers the exit code
run() { n=$1; shift; "$BIN" run --config /tmp/$n.toml "$@" >/out/$n.jsonl 2>/out/$n.err; }
frames() { grep -c '"type":"frame"' /out/$1.jsonl; }
has() { grep -q "$2" /out/$1.jsonl; }
ready() { for _ in $(seq 200); do /bin/probe caps $1 >/dev/null 2>&1 && return; sleep 0.1; done; fail "no camera at $1"; }
no_panic() { if grep -l panicked /out/*.err; then fail "panic"; fi; }
