# USB thermal cameras played to the real uvcvideo driver.
. /data/lib.sh
play() { /bin/probe usbcam "$@" >/tmp/usb.log 2>&1 & usb=$!; ready /dev/video0; }
unplug() { kill $usb 2>/dev/null; wait $usb 2>/dev/null; for _ in $(seq 100); do [ -e /dev/video0 ] || return; sleep 0.1; done; }
export SENSOR=thermal
play purethermal --fps 9
for size in 160x120 160x122; do
  PROFILE=lepton config lepton$size /dev/video0 Y16 $size; run lepton$size --frames 20; rc=$?
  c=$(sed -n 's/.*"celsius":{"mean":\([0-9.]*\).*/\1/p' /out/lepton$size.jsonl | head -1)
  if [ $rc = 0 ] && awk -v c="$c" 'BEGIN { exit !(c > 15 && c < 40) }'; then ok "PureThermal $size: $c degrees"; else fail "PureThermal $size: exit $rc, $c degrees: $(tail -1 /out/lepton$size.err)"; fi
done
PROFILE=lepton config uyvy /dev/video0 UYVY 160x120; run uyvy --frames 10; rc=$?
[ $rc = 0 ] && ok "PureThermal UYVY" || fail "PureThermal UYVY: exit $rc: $(tail -1 /out/uyvy.err)"
unplug
play p2pro --fps 25
PROFILE=p2 config p2 /dev/video0 YUYV 256x384; run p2 --frames 20; rc=$?
c=$(sed -n 's/.*"celsius":{"mean":\([0-9.]*\).*/\1/p' /out/p2.jsonl | head -1)
if [ $rc = 0 ] && awk -v c="$c" 'BEGIN { exit !(c > 15 && c < 40) }'; then ok "P2: $c degrees"; else fail "P2: exit $rc, $c degrees: $(tail -1 /out/p2.err)"; fi
unplug
play purethermal --fps 9 --error-every 8
PROFILE=lepton config usberror /dev/video0 Y16 160x120; run usberror --frames 30; rc=$?
[ $rc = 0 ] && grep -Eq '[1-9][0-9]* (missing|damaged)' /out/usberror.err && ok "USB errors: counted" || fail "USB errors: exit $rc: $(tail -2 /out/usberror.err)"
unplug
play purethermal --fps 9 --unplug-at 25 --replug-ms 1500
PROFILE=lepton config usbplug /dev/video0 Y16 160x120; run usbplug & pid=$!
sleep 9; kill -TERM $(pidof tsda); wait $pid; rc=$?
[ $rc = 0 ] && has usbplug '"reason":"gone"' && has usbplug camera_back && ok "cable pulled and put back" || fail "cable: exit $rc: $(tail -3 /out/usbplug.err)"
unplug
no_panic
exit $bad
