#!/usr/bin/env bash
# Training on a graphics device against the CPU: losses and gradients of one step, losses over steps,
# several devices, and `tsda-train fit --device wgpu` stopped and resumed.
#
#   tests/wgpu/run.sh [cargo test flags]
#
# Without a graphics driver, Mesa's software one (lavapipe) is installed through apt-get when run as
# root; it is what the figures in docs/training.md are from. Where that cannot be had, the tests say
# "skipped". The cargo feature makes burn compile once more (about half an hour of CPU time), so this
# is no part of scripts/test.sh.
set -euo pipefail
cd "$(dirname "$0")/../.."

have_driver() {
  for folder in /usr/share/vulkan/icd.d /etc/vulkan/icd.d /usr/local/share/vulkan/icd.d; do
    compgen -G "$folder/*.json" >/dev/null && return 0
  done
  [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ]
}
have_loader() { ldconfig -p 2>/dev/null | grep -q 'libvulkan\.so\.1'; }

if [ "$(uname -s)" = Linux ] && ! { have_driver && have_loader; }; then
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "no Vulkan driver: installing Mesa's" >&2
    export DEBIAN_FRONTEND=noninteractive
    if ! { apt-get update -qq && apt-get install -y -qq --no-install-recommends mesa-vulkan-drivers libvulkan1 >/dev/null; }; then
      echo "apt-get could not install mesa-vulkan-drivers (offline?): the tests will say 'skipped'" >&2
    fi
  else
    echo "no Vulkan driver; install mesa-vulkan-drivers and libvulkan1, or run this as root: the tests will say 'skipped'" >&2
  fi
fi
# From here on a device that cannot be opened is a failure.
if [ "$(uname -s)" != Linux ] || { have_driver && have_loader; }; then
  export TSDA_REQUIRE_WGPU=1
fi

# One at a time: a software device uses all cores.
cargo test --workspace --locked --features tsda-trainer/wgpu --lib "$@" wgpu_tests -- --show-output --test-threads 1
exec cargo test --workspace --locked --features tsda-trainer/wgpu --test fit "$@" graphics_device -- --show-output
