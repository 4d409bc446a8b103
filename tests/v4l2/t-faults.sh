# Faults of vivid while the program runs: it recovers or ends with the documented code.
. /data/lib.sh
D=/dev/video0
set_control() { /bin/probe set $D "$1" $2 || fail "control $1"; }
# start NAME [keys of v4l2]: a run that has tracked a few pictures
start() {
  config $1 $D YUYV 640x480 "rate = 30.0${2:+, $2}"; begin $1
  until_true 40 goes_on $1 0 8 || fail "$1: no pictures: $(tail -2 /out/$1.err)"
  from=$(lines $1)
}
# back NAME WHAT: at least eight good pictures more, in 30 s
back() { until_true 30 goes_on $1 $from 8 && ok "$2" || fail "$2: no pictures again: $(tail -2 /out/$1.err)"; }
# count NAME WORD LEAST MOST
count() {
  c=$(figure $1 "$2")
  [ -n "$c" ] && [ $c -ge $3 ] && [ $c -le $4 ] && ok "$1: $c $2" || fail "$1: ${c:-no figure} $2, not $3 to $4: $(tail -2 /out/$1.err)"
}
# held PID: descriptors of cameras, threads and mappings of buffers
held() { echo "$(ls -l /proc/$1/fd | grep -c video) $(ls /proc/$1/task | wc -l) $(grep -c video /proc/$1/maps)"; }
rss() { awk '/VmRSS/ { print $2 }' /proc/$1/status; }
unplug() { echo vivid.0 >/sys/bus/platform/drivers/vivid/unbind; }
plug() { echo vivid.0 >/sys/bus/platform/drivers/vivid/bind; }

start error; set_control "Inject V4L2_BUF_FLAG_ERROR" 1
back error "error flag: the run goes on"; end error "error flag"; count error damaged 1 1; count error restarts 0 0
start drop; set_control "Percentage of Dropped Buffers" 40; sleep 3; set_control "Percentage of Dropped Buffers" 0
from=$(lines drop); back drop "dropped buffers: the run goes on"; end drop "dropped buffers"; count drop missing 3 500
start stall; set_control "Percentage of Dropped Buffers" 100
until_true 10 has stall '"camera_lost","source":"cam","reason":"late"' || fail "stall: not late"
set_control "Percentage of Dropped Buffers" 0
from=$(lines stall); back stall "stall: late, then back"
set_control "Percentage of Dropped Buffers" 100; sleep 7; set_control "Percentage of Dropped Buffers" 0
from=$(lines stall); back stall "stall of seven seconds: back"
end stall stall; has stall '"camera_back"' || fail "stall: not said to be back"; count stall restarts 1 1

# Fatal errors, again and again: a new stream each time, and nothing is kept of the old ones.
start fatal; one=$(held $pid)
for i in 1 2 3 4 5 6; do
  set_control "Inject Fatal Streaming Error" 1; sleep 0.5
  from=$(lines fatal); back fatal "fatal error $i: a new stream"
  [ $i != 2 ] || kib=$(rss $pid)
done
[ "$(held $pid)" = "$one" ] && ok "nothing is kept: $one" || fail "kept: descriptors, threads, mappings $(held $pid), not $one"
grown=$(($(rss $pid) - kib)); [ $grown -lt 1500 ] && ok "memory: $grown KiB more" || fail "memory: $grown KiB more after four restarts"
end fatal "fatal errors"; count fatal restarts 6 6
# Buffers are refused in the middle, and at the new start.
start qbuf; set_control "Inject VIDIOC_QBUF Error" 1
sleep 0.5; from=$(lines qbuf); back qbuf "a refused buffer: a new stream"; end qbuf "refused buffer"; count qbuf restarts 1 1
for what in REQBUFS QBUF STREAMON; do
  start re$what; set_control "Inject VIDIOC_$what Error" 1; set_control "Inject Fatal Streaming Error" 1
  sleep 0.5; from=$(lines re$what); back re$what "$what refused at the new start: tried again"; end re$what "$what"
  [ $what = QBUF ] || has re$what '"camera_unavailable","source":"cam","reason":".*start streaming: Invalid argument' && ok "$what: the reason is told" || fail "$what: no reason: $(tail -3 /out/re$what.err)"
done
set_control "Inject VIDIOC_STREAMON Error" 1; config start $D YUYV 640x480; run start; rc=$?
[ $rc = 2 ] && grep -q "start streaming" /out/start.err && ok "STREAMON refused at the first start: exit 2" || fail "STREAMON at the start: exit $rc: $(tail -2 /out/start.err)"

# Numbers and times that wrap.
set_control "Wrap Sequence Number" 1
start seq; has seq '"sequence":42949[0-9]*,' || fail "seq: begins with $(grep -o '"sequence":[0-9]*' /out/seq.jsonl | head -1)"
until_true 30 has seq '"sequence":[0-9]\{1,3\},' && ok "sequence numbers wrap" || fail "seq: no wrap"
from=$(lines seq); back seq "and go on"; end seq "wrapped sequence"; count seq missing 0 400; count seq restarts 0 0
set_control "Wrap Sequence Number" 0
for i in 1 2; do
  set_control "Wrap Timestamp" $i; start stamp$i; back stamp$i "wrapped time stamps ($i)"; end stamp$i "wrapped time stamps"
  sed -n 's/.*"latency_ms":\([0-9.]*\).*/\1/p' /out/stamp$i.jsonl | awk '$1 > 15000 { bad = 1 } END { exit bad }' && ok "latency is sane" || fail "latency with wrapped time stamps ($i)"
done
set_control "Wrap Timestamp" 0
# Another program has the camera.
start first
config second $D YUYV 640x480 "rate = 30.0"; run second; rc=$?
[ $rc = 2 ] && grep -qi "busy" /out/second.err && ok "in use: exit 2" || fail "in use: exit $rc: $(tail -1 /out/second.err)"
config third $D YUYV 640x480 "rate = 30.0, wait = true"; firstpid=$pid; begin third; thirdpid=$pid
until_true 20 has third '"camera_unavailable".*busy' && ok "in use: waited for, with the reason" || fail "in use: $(tail -2 /out/third.err)"
pid=$firstpid; end first "first user"; pid=$thirdpid; from=0; back third "free again: taken"; end third "second user"

# Unplugged: by the driver's own control, by unbinding; and plugged in again.
start disconnect; set_control "Disconnect" 1
until_true 10 has disconnect '"reason":"gone"' || fail "disconnect: not seen"
from=$(lines disconnect); back disconnect "disconnected and back"; end disconnect disconnect; count disconnect "times unplugged" 1 1
start plug; one=$(held $pid)
for i in 1 2 3; do
  unplug; until_true 10 shows plug 'gone' || fail "unplugged: not seen"; sleep 1
  plug; from=$(lines plug); back plug "unplugged and back ($i)"
done
[ "$(held $pid)" = "$one" ] && ok "nothing is kept: $one" || fail "kept: descriptors, threads, mappings $(held $pid), not $one"
end plug plug; count plug "times unplugged" 3 3; has plug camera_back || fail "unplugged: not said to be back"
# The signal while it is looked for, and a name that lasts.
mkdir -p /dev/v4l/by-id; ln -sf ../../video0 /dev/v4l/by-id/usb-test
D0=$D; D=/dev/v4l/by-id/usb-test; start term; unplug; until_true 10 has term '"reason":"gone"'; t0=$(cut -d. -f1 /proc/uptime)
end term "SIGTERM while unplugged"; t1=$(cut -d. -f1 /proc/uptime); [ $((t1 - t0)) -le 3 ] && ok "SIGTERM while unplugged: $((t1 - t0)) s" || fail "SIGTERM took $((t1 - t0)) s"
# Not there at the start.
config late $D YUYV 640x480 "rate = 30.0, wait = true"; begin late; sleep 1; plug; from=0; back late "waited for at the start"; end late "waited for"
D=$D0
# Unplugged for good: the documented code.
GIVE_UP=2 config lost $D YUYV 640x480; begin lost; until_true 30 goes_on lost 0 5 || fail "lost: no pictures"
unplug; wait $pid; rc=$?; [ $rc = 4 ] && ok "gone for good: exit 4" || fail "gone for good: exit $rc"
no_panic
exit $bad
