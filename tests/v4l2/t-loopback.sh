# Two cameras of one scene: RGB and 16-bit thermal, a change by policy when the RGB camera dies.
. /data/lib.sh
FPS=${FPS:-10}
/bin/probe feed /dev/video20 --fourcc RGB3 --size 320x240 --fps $FPS -n 40 --file /data/clip/rgb.rgb3 --go /tmp/go >/tmp/rgb.log & a=$!
/bin/probe feed /dev/video21 --fourcc "Y16 " --size 320x240 --fps $FPS -n 96 --file /data/clip/thermal.y16 --go /tmp/go >/tmp/thermal.log & b=$!
ready /dev/video20; ready /dev/video21
box=$(head -1 /data/clip/truth.txt)
cat >/tmp/two.toml <<C
give_up_s = 3
[[source]]
name = "rgb"
sensor = "rgb"
v4l2 = { device = "/dev/video20", format = "RGB3", size = [320, 240] }
health = { frozen_s = 0 }
[[source]]
name = "thermal"
sensor = "thermal"
v4l2 = { device = "/dev/video21", format = "Y16", size = [320, 240] }
health = { frozen_s = 0 }
[target]
box = [$box]
[switch.failure]
return_after_s = -1
[[output.json]]
to = "stdout"
queue = 4096
C
run two & pid=$!
sleep 3; touch /tmp/go
wait $pid; rc=$?
[ $rc = 4 ] && ok "both writers at their end: exit 4" || fail "exit $rc: $(tail -3 /out/two.err)"
grep -q '"event":"switched","from":"rgb","to":"thermal","reason":"failure: late"' /out/two.jsonl && ok "changed when the camera died" || fail "no change"
# Sequence numbers of the loopback count what was written: those while the feeder waited are frame 0.
held_a=$(sed -n 's/held //p' /tmp/rgb.log) held_b=$(sed -n 's/held //p' /tmp/thermal.log)
awk -v ha=$held_a -v hb=$held_b '
  FNR == NR { split($0, t, ","); for (i = 1; i <= 4; i++) T[FNR - 1, i] = t[i]; next }
  /"type":"frame"/ && /"predicted":false/ && /"box"/ {
    match($0, /"sequence":[0-9]+/); s = substr($0, RSTART + 11, RLENGTH - 11) + 0
    match($0, /"source":"[a-z]+/); src = substr($0, RSTART + 10, RLENGTH - 10)
    match($0, /"box":\[[^]]*/); split(substr($0, RSTART + 7, RLENGTH - 7), b, ",")
    k = s - (src == "rgb" ? ha : hb); if (k < 0) k = 0; if (k > 95) next
    w = (b[1] + b[3] < T[k, 1] + T[k, 3] ? b[1] + b[3] : T[k, 1] + T[k, 3]) - (b[1] > T[k, 1] ? b[1] : T[k, 1])
    h = (b[2] + b[4] < T[k, 2] + T[k, 4] ? b[2] + b[4] : T[k, 2] + T[k, 4]) - (b[2] > T[k, 2] ? b[2] : T[k, 2])
    inter = w > 0 && h > 0 ? w * h : 0
    sum[src] += inter / (b[3] * b[4] + T[k, 3] * T[k, 4] - inter); n[src]++
  }
  END {
    for (s in n) printf "%s: %d frames, mean IoU %.3f\n", s, n[s], sum[s] / n[s]
    exit !(n["rgb"] > 20 && n["thermal"] > 20 && sum["rgb"] / n["rgb"] > 0.4 && sum["thermal"] / n["thermal"] > 0.35)
  }' /data/clip/truth.txt /out/two.jsonl && ok "boxes meet the truth" || fail "boxes do not meet the truth"
kill $a $b 2>/dev/null; rm -f /tmp/go
# A writer that dies and comes back.
/bin/probe feed /dev/video20 --fourcc RGB3 --size 320x240 --fps 20 -n 1000 --file /data/clip/rgb.rgb3 >/dev/null & a=$!
ready /dev/video20
config writer /dev/video20 RGB3 320x240; run writer & pid=$!
sleep 2; kill -9 $a; sleep 2
/bin/probe feed /dev/video20 --fourcc RGB3 --size 320x240 --fps 20 -n 1000 --file /data/clip/rgb.rgb3 >/dev/null & a=$!
sleep 2; kill -TERM $(pidof tsda); wait $pid; rc=$?
[ $rc = 0 ] && has writer camera_lost && has writer camera_back && ok "writer died and came back" || fail "writer: exit $rc: $(tail -3 /out/writer.err)"
kill -9 $a
# Compressed pictures.
/bin/probe feed /dev/video21 --fourcc MJPG --size 320x240 --fps 20 -n 1000 --file /data/clip/rgb.mjpg >/dev/null & a=$!
ready /dev/video21
config mjpg /dev/video21 MJPG 320x240; run mjpg --frames 30; rc=$?
[ $rc = 0 ] && [ "$(grep -c '"picture":"good"' /out/mjpg.jsonl)" -ge 25 ] && ok "MJPG" || fail "MJPG: exit $rc: $(tail -2 /out/mjpg.err)"
kill -9 $a
no_panic
exit $bad
