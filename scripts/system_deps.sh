#!/bin/sh
# system_deps.sh: the system packages with which MuJoCo and SAPIEN draw without a screen on Debian and Ubuntu.
# OSMesa for MuJoCo; a Vulkan device for SAPIEN, on the CPU by Mesa's lavapipe, which must be 24.3 or newer.
# Nothing is done where both are there already.
set -eu

[ "$(id -u)" = 0 ] && sudo="" || sudo=sudo
command -v apt-get >/dev/null || {
    echo "error: apt-get not found; install OSMesa and a Vulkan driver (Mesa >= 24.3) with your package manager" >&2
    exit 2
}
installed() { dpkg-query -W -f '${Version}' "$1" 2>/dev/null; }
new_enough() { dpkg --compare-versions "${1:-0}" ge 24.3; }

if [ -n "$(installed libosmesa6)" ] && [ -n "$(installed libvulkan1)" ] &&
    new_enough "$(installed mesa-vulkan-drivers)"; then
    exit 0
fi
export DEBIAN_FRONTEND=noninteractive
install() { $sudo apt-get install -y -qq --no-install-recommends "$@" >/dev/null; }
$sudo apt-get update -qq
install libosmesa6 libvulkan1
if ! new_enough "$(apt-cache policy mesa-vulkan-drivers | sed -n 's/ *Candidate: //p')"; then
    . /etc/os-release
    suite=$VERSION_CODENAME-backports
    echo "adding the suite $suite for a newer mesa-vulkan-drivers"
    echo "deb http://deb.debian.org/debian $suite main" | $sudo tee "/etc/apt/sources.list.d/$suite.list" >/dev/null
    $sudo apt-get update -qq
    install -t "$suite" mesa-vulkan-drivers
else
    install mesa-vulkan-drivers
fi
