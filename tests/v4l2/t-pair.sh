# Two USB cameras of one scene, by their lasting names: the colour camera is pulled out while it tracks
# and put back later. Boxes are compared with the truth by the driver's time stamps.
. /data/lib.sh
FPS=8
# What udev does: names by serial number, for the nodes that deliver pictures.
udev() {
  mkdir -p /dev/v4l/by-id
  while :; do
    for l in /dev/v4l/by-id/*; do [ -e "$l" ] || rm -f "$l"; done
    for d in /sys/class/video4linux/video*; do
      [ "$(cat $d/index 2>/dev/null)" = 0 ] || continue
      name=$(cat $d/name 2>/dev/null); l=/dev/v4l/by-id/${name%% *}
      [ -e "$l" ] || [ ! -e /dev/${d##*/} ] || ln -sf ../../${d##*/} "$l"
    done
    sleep 0.1
  done
}
udev 2>/dev/null & udev=$!
colour() { /bin/probe usbcam webcam --fps $FPS --file /data/clip/rgb.rgb3 --go /tmp/go >/tmp/webcam.log 2>&1 & webcam=$!; }
colour; ready /dev/v4l/by-id/Colour
/bin/probe usbcam thermal --fps $FPS --file /data/clip/thermal.y16 --go /tmp/go >/tmp/thermal.log 2>&1 & thermal=$!
ready /dev/v4l/by-id/Thermal
cat >/tmp/pair.toml <<C
give_up_s = 5
[[source]]
name = "rgb"
sensor = "rgb"
v4l2 = { device = "/dev/v4l/by-id/Colour", format = "YUYV", size = [320, 240] }
health = { frozen_s = 0, timeout_s = 3 }
[[source]]
name = "thermal"
sensor = "thermal"
v4l2 = { device = "/dev/v4l/by-id/Thermal", format = "Y16", size = [320, 240] }
health = { frozen_s = 0, timeout_s = 3 }
[target]
box = [$(head -1 /data/clip/truth.txt)]
[switch.failure]
return_after_s = 1
[[output.json]]
to = "stdout"
queue = 4096
C
begin pair; until_true 40 goes_on pair 0 4 || fail "no pictures: $(tail -3 /out/pair.err)"
from=$(lines pair); t0=$(cut -d' ' -f1 /proc/uptime); touch /tmp/go
until_true 30 goes_on pair $from 24 || fail "no pictures of the scene: $(tail -3 /out/pair.err)"
kill -9 $webcam
until_true 5 has pair '"event":"switched","from":"rgb","to":"thermal","reason":"failure: gone"' && ok "pulled out: changed at once" || fail "no change: $(tail -3 /out/pair.err)"
from=$(lines pair); until_true 30 goes_on pair $from 14 || fail "no thermal pictures: $(tail -3 /out/pair.err)"
colour
until_true 20 has pair '"event":"switched","from":"thermal","to":"rgb","reason":"recovered"' && ok "put back: used again" || fail "not used again: $(tail -3 /out/pair.err)"
back=$(lines pair)
until_true 20 goes_on pair $back 12 || fail "no pictures after the return"
end pair pair
[ "$(grep -c '"event":"switched"' /out/pair.jsonl)" = 2 ] && ok "no other change" || fail "changes: $(grep switched /out/pair.err)"
c=$(figure pair "times unplugged"); [ "$c" = 1 ] && ok "counted" || fail "unplugged: $c times: $(tail -3 /out/pair.err)"
# mean IoU of the frames that were tracked in, by source and for the time after the return
awk -v t0=$t0 -v fps=$FPS -v back=$back '
  FNR == NR { split($0, t, ","); for (i = 1; i <= 4; i++) T[FNR - 1, i] = t[i]; last = FNR - 1; next }
  /"type":"frame"/ && /"predicted":false/ && /"box"/ {
    match($0, /"capture":[0-9.]+/); at = substr($0, RSTART + 10, RLENGTH - 10)
    match($0, /"source":"[a-z]+/); src = substr($0, RSTART + 10, RLENGTH - 10)
    match($0, /"box":\[[^]]*/); split(substr($0, RSTART + 7, RLENGTH - 7), b, ",")
    k = int((at - t0) * fps); if (k < 0) k = 0; if (k > last) k = last
    w = (b[1] + b[3] < T[k, 1] + T[k, 3] ? b[1] + b[3] : T[k, 1] + T[k, 3]) - (b[1] > T[k, 1] ? b[1] : T[k, 1])
    h = (b[2] + b[4] < T[k, 2] + T[k, 4] ? b[2] + b[4] : T[k, 2] + T[k, 4]) - (b[2] > T[k, 2] ? b[2] : T[k, 2])
    inter = w > 0 && h > 0 ? w * h : 0; iou = inter / (b[3] * b[4] + T[k, 3] * T[k, 4] - inter)
    sum[src] += iou; n[src]++
    if (FNR > back) { sum["return"] += iou; n["return"]++ }
  }
  END {
    for (s in n) printf "%s: %d frames, mean IoU %.3f\n", s, n[s], sum[s] / n[s]
    exit !(n["rgb"] >= 30 && n["thermal"] >= 10 && n["return"] >= 10 && sum["rgb"] / n["rgb"] > 0.4 && sum["thermal"] / n["thermal"] > 0.35 && sum["return"] / n["return"] > 0.4)
  }' /data/clip/truth.txt /out/pair.jsonl && ok "boxes meet the truth" || fail "boxes do not meet the truth"
kill -9 $webcam $thermal $udev
no_panic
exit $bad
