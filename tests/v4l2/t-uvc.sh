# USB thermal cameras played to the real uvcvideo driver.
. /data/lib.sh
play() { /bin/probe usbcam "$@" >/tmp/usb.log 2>&1 & usb=$!; ready /dev/video0; }
gone() { [ ! -e /dev/video0 ]; }
unplug() { kill $usb 2>/dev/null; wait $usb 2>/dev/null; until_true 10 gone || fail "the camera is still there"; }
nodrop() { echo $1 >/sys/module/uvcvideo/parameters/nodrop || echo "skipped: this kernel has no nodrop: what it does with damaged frames is not chosen"; }
# warm NAME WHAT: the box shows the background, 20 to 22 degrees, and where the target has come in its 37
warm() {
  c=$(sed -n 's/.*"celsius":{"mean":\([0-9.]*\),"max":\([0-9.]*\)}.*/\1 \2/p' /out/$1.jsonl | head -1)
  if [ $rc = 0 ] && echo "$c" | awk '{ exit !($1 > 19.5 && $1 <= $2 && ($2 < 22.5 || $2 > 36.9 && $2 < 37.1)) }'; then
    ok "$2: $c degrees, mean and warmest"
  else fail "$2: exit $rc, $c degrees: $(tail -1 /out/$1.err)"; fi
}
# counted NAME WHAT WORD
counted() { [ "$(figure $1 $3)" -ge 1 ] && ok "$2: $(figure $1 $3) $3" || fail "$2: no $3: $(tail -2 /out/$1.err)"; }
export SENSOR=thermal
play purethermal --fps 9 --ffc-every 40 --ffc-frames 6
PROFILE=lepton config lepton160x122 /dev/video0 Y16 160x122; run lepton160x122 --frames 20; rc=$?
warm lepton160x122 "PureThermal 160x122"
# Without telemetry nobody says that raw values are temperatures, but for the configuration.
PROFILE=lepton config lepton160x120 /dev/video0 Y16 160x120; run lepton160x120 --frames 5; rc=$?
[ $rc = 0 ] && ! has lepton160x120 celsius && ok "PureThermal 160x120: no temperature" || fail "PureThermal 160x120: exit $rc, a temperature that nobody stands for"
PROFILE=lepton SCALE=0.01 config stated /dev/video0 Y16 160x120; run stated --frames 20; rc=$?
warm stated "PureThermal 160x120 with its scale"
# The telemetry rows say when the shutter is closed. It may be when the run begins; then nobody has taken the
# target yet, so the test begins with the next time.
begin lepton160x122
until_true 30 goes_on lepton160x122 0 5 || fail "shutter: no pictures: $(tail -2 /out/lepton160x122.err)"
from=$(lines lepton160x122)
since() { tail -n +$(($from + 1)) /out/lepton160x122.jsonl | grep -q "$1"; }
until_true 30 since '"camera_lost","source":"cam","reason":"shutter"' && ok "shutter: seen" || fail "shutter: not seen: $(tail -2 /out/lepton160x122.err)"
until_true 20 since '"picture":"shutter","box":\[.*"predicted":true' && ok "shutter: predicted" || fail "shutter: not predicted"
from=$(lines lepton160x122); until_true 20 goes_on lepton160x122 $from 5 && has lepton160x122 camera_back && ok "shutter: over" || fail "shutter: not over"
end lepton160x122 shutter
grep '"picture":"shutter","box":\[' /out/lepton160x122.jsonl | grep -q '"predicted":false' && fail "shutter: tracked in"
PROFILE=lepton config uyvy /dev/video0 UYVY 160x120; run uyvy --frames 10; rc=$?
[ $rc = 0 ] && [ "$(good uyvy 0)" -ge 8 ] && ok "PureThermal UYVY" || fail "PureThermal UYVY: exit $rc: $(tail -1 /out/uyvy.err)"
config grey /dev/video0 GREY 160x120; run grey --frames 10; rc=$?
[ $rc = 0 ] && ok "PureThermal GREY" || fail "PureThermal GREY: exit $rc: $(tail -1 /out/grey.err)"
# Asked for what this camera does not have.
PROFILE=lepton config size /dev/video0 Y16 80x63; run size --frames 5; rc=$?
[ $rc = 2 ] && grep -q "asked for 80 x 63" /out/size.err && ok "wrong size: exit 2" || fail "wrong size: exit $rc: $(tail -1 /out/size.err)"
unplug
play purethermal --fps 9 --tlinear 0
PROFILE=lepton config counts /dev/video0 Y16 160x122; run counts --frames 5; rc=$?
[ $rc = 0 ] && ! has counts celsius && ok "PureThermal without TLinear: no temperature" || fail "PureThermal without TLinear: exit $rc, or a temperature"
unplug
play boson --fps 9
for size in 640x512 640x514; do
  PROFILE=boson config boson$size /dev/video0 Y16 $size; run boson$size --frames 10; rc=$?
  [ $rc = 0 ] && grep -q '"size":\[640,512\]' /out/boson$size.jsonl && ! has boson$size celsius && ok "Boson $size" || fail "Boson $size: exit $rc: $(tail -1 /out/boson$size.err)"
done
unplug
play p2pro --fps 25
PROFILE=p2 config p2 /dev/video0 YUYV 256x384; run p2 --frames 20; rc=$?
warm p2 P2; grep -q '"size":\[256,192\]' /out/p2.jsonl || fail "P2: size"
unplug
# Damaged and short frames: swallowed by the driver (nodrop=0), or delivered with a mark (nodrop=1).
for kind in error short; do
  for mode in 0:missing 1:damaged; do
    nodrop ${mode%:*}; play purethermal --fps 9 --$kind-every 6
    n=$kind${mode%:*}; PROFILE=lepton config $n /dev/video0 Y16 160x120; run $n --frames 30; rc=$?
    [ $rc = 0 ] || fail "$n: exit $rc: $(tail -2 /out/$n.err)"
    counted $n "USB $kind, nodrop=${mode%:*}" ${mode#*:}
    unplug
  done
  grep '"picture":"damaged","box":\[' /out/${kind}1.jsonl | grep -q '"predicted":false' && fail "$kind: tracked in a damaged picture"
done
nodrop 0
play purethermal --fps 9 --stall-at 30 --stall-ms 2500
PROFILE=lepton config stall /dev/video0 Y16 160x120; begin stall
until_true 30 has stall '"reason":"late"' || fail "stall: not late: $(tail -2 /out/stall.err)"
from=$(lines stall); until_true 20 goes_on stall $from 5 && has stall camera_back && ok "stall: late and back" || fail "stall: $(tail -2 /out/stall.err)"
end stall stall; unplug
play purethermal --fps 9 --unplug-at 25 --replug-ms 1500
PROFILE=lepton config usbplug /dev/video0 Y16 160x120; begin usbplug
until_true 30 has usbplug '"reason":"gone"' || fail "cable: not seen"
from=$(lines usbplug); until_true 20 goes_on usbplug $from 5 && has usbplug camera_back && ok "cable pulled and put back" || fail "cable: $(tail -3 /out/usbplug.err)"
end usbplug cable; unplug
no_panic
exit $bad
