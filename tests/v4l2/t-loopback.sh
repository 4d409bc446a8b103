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
health = { frozen_s = 0, timeout_s = 1.5 }
[[source]]
name = "thermal"
sensor = "thermal"
v4l2 = { device = "/dev/video21", format = "Y16", size = [320, 240] }
health = { frozen_s = 0, timeout_s = 1.5 }
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
# A loopback without a writer is waited for, and the reason is told; a writer that dies and comes back
# goes on in the same stream; one that stays away costs the stream; one of another size is refused.
write() { /bin/probe feed /dev/video20 --fourcc RGB3 --size ${1:-320x240} --fps 20 -n 1000 --file /data/clip/rgb.rgb3 >/dev/null & a=$!; }
config early /dev/video20 RGB3 320x240; run early; rc=$?
[ $rc = 2 ] && grep -q "once it has a writer" /out/early.err && ok "no writer: exit 2" || fail "no writer: exit $rc: $(tail -2 /out/early.err)"
config writer /dev/video20 RGB3 320x240 "wait = true"; begin writer
until_true 20 has writer '"camera_unavailable".*once it has a writer' && ok "no writer: waited for" || fail "no writer: $(tail -2 /out/writer.err)"
write; until_true 30 goes_on writer 0 8 && ok "a writer came" || fail "a writer came: $(tail -2 /out/writer.err)"
kill -9 $a; until_true 10 has writer '"reason":"late"' || fail "the writer's death is not seen"
sleep 1; write; from=$(lines writer); until_true 20 goes_on writer $from 8 && ok "writer died and came back" || fail "writer: $(tail -3 /out/writer.err)"
kill -9 $a; wait $a; sleep 7
write 160x120; until_true 20 has writer '"camera_unavailable".*asked for 320 x 240 RGB3, the camera answers 160 x 120 RGB3' && ok "a writer of another size: the reason is told" || fail "another size: $(tail -3 /out/writer.err)"
kill -9 $a; wait $a; sleep 1
write; from=$(lines writer); until_true 20 goes_on writer $from 8 && ok "the right writer came back" || fail "right writer: $(tail -3 /out/writer.err)"
end writer "writers"; c=$(figure writer restarts); [ "$c" = 1 ] && ok "one restart" || fail "restarts: $c: $(tail -2 /out/writer.err)"
kill -9 $a
# Compressed pictures.
/bin/probe feed /dev/video21 --fourcc MJPG --size 320x240 --fps 20 -n 1000 --file /data/clip/rgb.mjpg >/dev/null & a=$!
ready /dev/video21
config mjpg /dev/video21 MJPG 320x240; run mjpg --frames 30; rc=$?
[ $rc = 0 ] && [ "$(good mjpg 0)" -ge 25 ] && ok "MJPG: $(tail -1 /out/mjpg.err)" || fail "MJPG: exit $rc: $(tail -2 /out/mjpg.err)"
kill -9 $a
no_panic
exit $bad
