# For the scripts in the virtual machine (busybox sh): $BIN is tsda, /bin/probe plays cameras.
bad=0
fail() { echo "FAIL: $*"; bad=$((bad + 1)); }
ok() { echo "ok: $*"; }

# config NAME DEVICE FORMAT WxH [more keys of v4l2]: a configuration with one camera; PATIENT: pictures may
# take three seconds, for tests that are not about time on a machine that may be busy
config() {
  profile=
  [ -z "${PROFILE:-}" ] || profile="profile = \"$PROFILE\""
  [ -z "${SCALE:-}" ] || profile="$profile
celsius = { scale = $SCALE, offset = -273.15 }"
  cat >/tmp/$1.toml <<C
give_up_s = ${GIVE_UP:-30}
[[source]]
name = "cam"
sensor = "${SENSOR:-rgb}"
$profile
${PATIENT:+health = { timeout_s = 3 \}}
v4l2 = { device = "$2", format = "$3", size = [${4%x*}, ${4#*x}]${5:+, $5} }
[target]
box = [${BOX:-40, 30, 40, 40}]
[[output.json]]
to = "stdout"
queue = 4096
C
}
# run NAME [ARG...]: leaves /out/NAME.jsonl and /out/NAME.err, answers the exit code
run() { n=$1; shift; "$BIN" run --config /tmp/$n.toml "$@" >/out/$n.jsonl 2>/out/$n.err; }
# begin NAME [ARG...]: the same in the background; $pid is tsda itself
begin() {
  n=$1; shift; : >/out/$n.jsonl; : >/out/$n.err
  "$BIN" run --config /tmp/$n.toml "$@" >/out/$n.jsonl 2>/out/$n.err &
  pid=$!
}
# end NAME WHAT: SIGTERM, and the exit code has to be 0
end() {
  kill -TERM $pid 2>/dev/null; wait $pid; rc=$?
  [ $rc = 0 ] || fail "$2: exit $rc: $(tail -3 /out/$1.err)"
}
frames() { grep -c '"type":"frame"' /out/$1.jsonl; }
has() { grep -q "$2" /out/$1.jsonl; }
# until_true SECONDS COMMAND...: waits, answers whether it came true
until_true() {
  s=$(($1 * 10)); shift
  while [ $s -gt 0 ]; do "$@" && return; s=$((s - 1)); sleep 0.1; done
  return 1
}
shows() { grep -q "$2" /out/$1.jsonl /out/$1.err; }
# good NAME FROM: number of frames with a good picture after the first FROM lines
good() { tail -n +$(($2 + 1)) /out/$1.jsonl | grep -c '"picture":"good"'; }
lines() { wc -l </out/$1.jsonl; }
goes_on() { from=$2; [ "$(good $1 $from)" -ge "${3:-5}" ]; }
# figure NAME WORD: the number before WORD in the line of the first source, at the end of a run
figure() { sed -n "s/.*source [a-z]*: .*[ ,]\([0-9][0-9]*\) $2.*/\1/p" /out/$1.err | head -1; }
# settled NAME WHAT FRAME: the loop allocated nothing from that frame on
settled() {
  loop=$(sed -n 's/^loop: \([0-9]*\) allocations.*/\1/p' /out/$1.err)
  last=$(sed -n 's/^loop: .*the last in frame \([0-9]*\)$/\1/p' /out/$1.err)
  [ -n "$loop" ] && [ "${last:-0}" -lt $3 ] && ok "$2: $loop allocations, the last in frame ${last:-none}, of $(frames $1)" ||
    fail "$2: $(grep '^loop:' /out/$1.err || echo 'no figure')"
}
ready() { until_true 20 sh -c "/bin/probe caps $1 >/dev/null 2>&1" || fail "no camera at $1"; }
no_panic() { if grep -l panicked /out/*.err; then fail "panic"; fi; }
