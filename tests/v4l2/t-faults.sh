# Faults of vivid while the program runs: it recovers or ends with the documented code.
. /data/lib.sh
D=/dev/video0
start() { config $1 $D YUYV 640x480 "rate = 30.0"; run "$@" & pid=$!; sleep 3; }
# expect NAME WHAT PATTERN: ends the run with SIGTERM and looks for what should have been said
expect() {
  kill -TERM $(pidof tsda) 2>/dev/null; wait $pid; rc=$?
  if [ $rc = 0 ] && grep -q "$3" /out/$1.err /out/$1.jsonl; then ok "$2 ($(frames $1) frames)"; else fail "$2: exit $rc: $(tail -3 /out/$1.err)"; fi
}
set_control() { /bin/probe set $D "$1" $2 || fail "control $1"; }

start error; set_control "Inject V4L2_BUF_FLAG_ERROR" 1; sleep 1
expect error "error flag: a picture is damaged, the run goes on" ' 1 damaged'
start drop; set_control "Percentage of Dropped Buffers" 40; sleep 2; set_control "Percentage of Dropped Buffers" 0
expect drop "dropped buffers are counted" 'over, [1-9][0-9]* missing'
start wrap; set_control "Percentage of Dropped Buffers" 100; sleep 2; set_control "Percentage of Dropped Buffers" 0; sleep 2
expect wrap "stall: late, then back" 'camera_back'
start fatal; set_control "Inject Fatal Streaming Error" 1; sleep 3
expect fatal "fatal error: a new stream" '[1-9] restarts'
has fatal camera_back || [ "$(frames fatal)" -gt 40 ] && ok "pictures after the restart" || fail "no pictures after the restart"
/bin/probe set $D "Wrap Sequence Number" 1
start seq; sleep 5
expect seq "sequence numbers wrap without pictures counted as missing" ' [0-9]\{1,3\} missing'
/bin/probe set $D "Wrap Sequence Number" 0
# Unplugged and plugged in again.
start plug
echo vivid.0 >/sys/bus/platform/drivers/vivid/unbind; sleep 1
echo vivid.0 >/sys/bus/platform/drivers/vivid/bind; sleep 4
expect plug "unplugged and back" 'camera_back'
grep -q '1 times unplugged' /out/plug.err && ok "counted" || fail "not counted: $(tail -2 /out/plug.err)"
# Unplugged for good: the documented code.
config lost $D YUYV 640x480; sed -i 's/give_up_s = 8/give_up_s = 2/' /tmp/lost.toml; run lost & pid=$!; sleep 2
echo vivid.0 >/sys/bus/platform/drivers/vivid/unbind
wait $pid; rc=$?; [ $rc = 4 ] && ok "gone for good: exit 4" || fail "gone for good: exit $rc"
no_panic
exit $bad
