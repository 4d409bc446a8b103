# Every format, from the kernel's test driver.
. /data/lib.sh
for f in YUYV UYVY NV12 RGB3 BGR3 GREY Y16 Y10; do
  size=640x480; [ $f != Y10 ] || size=320x180
  sensor=rgb; case $f in Y1*) sensor=thermal ;; esac
  SENSOR=$sensor config $f /dev/video0 $f $size "rate = 30.0"
  run $f --frames 30; rc=$?
  if [ $rc = 0 ] && [ "$(frames $f)" = 30 ] && ! grep -q '"picture":"damaged"' /out/$f.jsonl; then
    ok "$f: $(tail -1 /out/$f.err)"
  else
    fail "$f: exit $rc, $(frames $f) frames: $(tail -1 /out/$f.err)"
  fi
done
# What cannot be is refused before anything runs.
config wrong /dev/video0 YUYV 123x45; run wrong; rc=$?
[ $rc = 2 ] && grep -q "asked for 123 x 45" /out/wrong.err && ok "wrong size: exit 2" || fail "wrong size: exit $rc"
config none /dev/video9 YUYV 640x480; run none; rc=$?
[ $rc = 2 ] && ok "no device: exit 2" || fail "no device: exit $rc"
config busy /dev/video0 YUYV 640x480 "controls = { \"No Such\" = 1 }"; run busy; rc=$?
[ $rc = 2 ] && grep -q "no control" /out/busy.err && ok "unknown control: exit 2" || fail "unknown control: exit $rc"
no_panic
exit $bad
