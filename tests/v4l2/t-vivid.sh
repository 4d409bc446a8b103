# Every format, from the kernel's test driver.
. /data/lib.sh
D=/dev/video0
"$BIN" devices >/out/devices.txt 2>&1
grep -q "^$D vivid" /out/devices.txt && grep -q "^  YUYV .*640x" /out/devices.txt && ok "devices" || fail "devices: $(cat /out/devices.txt)"
for f in YUYV UYVY NV12 RGB3 BGR3 GREY Y16 Y10; do
  size=640x480; [ $f != Y10 ] || size=320x180
  sensor=rgb; case $f in Y1*) sensor=thermal ;; esac
  PATIENT=y SENSOR=$sensor config $f $D $f $size "rate = 30.0"
  run $f --frames 30; rc=$?
  if [ $rc = 0 ] && [ "$(frames $f)" = 30 ] && [ "$(good $f 0)" = 30 ] && ! has $f '"predicted":true'; then
    ok "$f: $(tail -1 /out/$f.err)"
    settled $f "$f: the loop" 10
  else
    fail "$f: exit $rc, $(frames $f) frames, $(good $f 0) good: $(tail -3 /out/$f.err)"
  fi
done
# In the long run too, with the driver's buffers going round many times.
PATIENT=y config long $D YUYV 640x480 "rate = 30.0"; run long --frames 200; rc=$?
[ $rc = 0 ] || fail "long: exit $rc: $(tail -2 /out/long.err)"
settled long "the loop on a driver" 10
# What cannot be is refused before anything runs.
# refused NAME WHAT PATTERN: exit 2 and the reason
refused() { run $1 --frames 5; rc=$?; [ $rc = 2 ] && grep -q "$3" /out/$1.err && ok "$2: exit 2" || fail "$2: exit $rc: $(tail -2 /out/$1.err)"; }
config wrong $D YUYV 123x45; refused wrong "wrong size" "asked for 123 x 45"
config none /dev/video9 YUYV 640x480; refused none "no device" "No such file"
config control $D YUYV 640x480 "controls = { \"No Such\" = 1 }"; refused control "unknown control" "no control"
config range $D YUYV 640x480 "controls = { \"Brightness\" = 9999 }"; refused range "control out of range" "Brightness"
config file /dev/null YUYV 640x480; refused file "no camera" "/dev/null"
config set $D YUYV 640x480 "controls = { \"Brightness\" = 77 }"; run set --frames 2; rc=$?
[ $rc = 0 ] && [ "$(/bin/probe get $D Brightness)" = 77 ] && ok "a control is set" || fail "control: exit $rc, $(/bin/probe get $D Brightness)"
/bin/probe set $D Brightness 128
# What vivid draws is judged: black, white, and the same picture again and again.
# seen NAME WHAT PATTERN
judged() {
  config $1 $D YUYV 640x480 "rate = 30.0"; begin $1
  until_true 30 shows $1 "\"camera_lost\",\"source\":\"cam\",\"reason\":\"$1\"" && ok "$1" || fail "$1 is not seen: $(tail -2 /out/$1.err)"
  end $1 "$1"
}
/bin/probe set $D "OSD Text Mode" 2
/bin/probe set $D "Test Pattern" 5; judged dark
/bin/probe set $D "Test Pattern" 6; judged saturated
/bin/probe set $D "Test Pattern" 0; judged frozen
/bin/probe set $D "OSD Text Mode" 0
# The newest picture wins, and latency begins when the driver took it: after a second of standing still
# the driver's buffers hold pictures that are older than that.
config still $D YUYV 640x480 "rate = 30.0"; begin still
until_true 30 goes_on still 0 10 || fail "no pictures"
# On a busy machine a picture may be judged late before it is tracked: again, until three are seen.
latencies() { sed -n 's/.*"predicted":false.*"latency_ms":\([0-9.]*\),"track_ms":\([0-9.]*\).*/\1 \2/p' /out/still.jsonl | awk '$1 - $2 > 400 { n++ } $1 - $2 < 200 { soon++ } $1 > 15000 { wrong++ } END { print (n >= 3 && soon >= 10 && !wrong) ? "ok" : "bad", n + 0, soon + 0, wrong + 0 }'; }
for _ in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20; do
  kill -STOP $pid; sleep 1; kill -CONT $pid; sleep 1
  case $(latencies) in ok*) break ;; esac
done
end still "standing still"
late=$(latencies)
case $late in ok*) ok "latency begins at the driver's time stamp: ${late#ok } late, soon, wrong" ;; *) fail "latency: $late" ;; esac
[ "$(figure still 'passed over')" -ge 4 ] && ok "older pictures are passed over" || fail "passed over: $(tail -2 /out/still.err)"
no_panic
exit $bad
