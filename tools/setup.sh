#!/usr/bin/env bash
# Installs what is missing, and nothing when nothing is.
#
#   tools/setup.sh venv     .venv with the package, its extras and the pins of constraints.txt, and in it the ROS
#                           message packages that no wheel brings, compiled; EXTRAS=view,video,nifti,plot,pcap,hdf5,arrow,pandas,lerobot,seal,cohort,zenoh,websocket,lab,dev leaves ROS out
#   tools/setup.sh peers    what the C++ reference peer of the tests is built with
#   tools/setup.sh pictures what the viewer needs to draw pictures on a machine without graphics card
#   tools/setup.sh mri      the MR head Colin27 for the scenarios lego and brain, out of a package of Debian, which is
#                           unpacked into the user's cache folder and not installed
#
# System packages are installed where we are root or may sudo without a password; otherwise the command to type
# is printed.  Without Python we stop; without the rest the tests that need it skip, with that reason.
set -euo pipefail
cd "$(dirname "$0")/.."

VENV=.venv
PEER_PACKAGES=(g++ libopenigtlink-dev)
PICTURE_PACKAGES=(mesa-vulkan-drivers)

say() { printf '%s\n' "$@" >&2; }

# missing PACKAGE...: those that Debian does not have installed, one a line.
missing() {
    local package
    for package in "$@"; do
        dpkg-query -W -f='${db:Status-Status}' "$package" 2>/dev/null | grep -qx installed || printf '%s\n' "$package"
    done
}

# apt PACKAGE...: install them; false, with the command to type, where we cannot.
apt() {
    local as_root=()
    if ! command -v apt-get >/dev/null; then
        say "This is not Debian or Ubuntu. Please install what they call: $*"
        return 1
    fi
    if [ "$(id -u)" -ne 0 ]; then
        if ! sudo -n true 2>/dev/null; then
            say "Missing system packages. Please run:  sudo apt-get install $*"
            return 1
        fi
        as_root=(sudo -n)
    fi
    say "Installing system packages: $*"
    local log quietly=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120)
    if ! log=$({ "${quietly[@]}" update && "${quietly[@]}" install -y --no-install-recommends "$@"; } 2>&1 </dev/null); then
        say "$log" "apt-get could not install: $*"
        return 1
    fi
}

# The first Python that will do; $PYTHON goes before all.
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.11 python3 python3.12 python3.13 python3.14 python3.10}; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    return 1
}

make_venv() {
    local python version
    if ! python=$(find_python); then
        apt python3 python3-venv && python=$(find_python) || { say "Python 3.10 or newer is needed."; exit 1; }
    fi
    if ! "$python" -c 'import ensurepip' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        if command -v virtualenv >/dev/null; then
            virtualenv -q -p "$python" "$VENV"
            return
        fi
        apt "python$version-venv" || { say "Without it (or virtualenv) no environment can be made."; exit 1; }
    fi
    "$python" -m venv --clear "$VENV"
}

# install REQUIREMENT...: with uv, in a third of the time of pip, or with pip, where uv has no access to the packages because
# a mirror or a certificate is configured for pip only.
install() {
    local pip=("$VENV/bin/python" -m pip install -qq --disable-pip-version-check --retries 10 -c constraints.txt)
    if [ ! -x "$VENV/bin/uv" ]; then
        "${pip[@]}" uv </dev/null || true
    fi
    "$VENV/bin/uv" pip install -qq --python "$VENV/bin/python" -c constraints.txt "$@" </dev/null 2>/dev/null ||
        "${pip[@]}" "$@" </dev/null
}

setup_venv() {
    local extras=${EXTRAS:-ros,view,video,nifti,plot,pcap,hdf5,arrow,pandas,lerobot,seal,cohort,zenoh,websocket,lab,dev} attempt
    if [ -n "${AMENT_PREFIX_PATH:-}" ]; then
        # The wheels and a sourced ROS 2 do not go together in one environment.
        say "A ROS 2 environment is sourced: its rclpy is used, the ROS wheels are not installed."
        extras=${extras#ros,}
    fi
    "$VENV/bin/python" -c 'import pip' 2>/dev/null || make_venv
    say "Installing Python packages into $VENV (about 1 GB, a few minutes, only once)."
    for attempt in 1 2 3; do
        if install -e ".[$extras]" -e ./lab; then
            setup_interfaces
            return
        fi
        say "That failed (attempt $attempt of 3)."
        sleep "$attempt"
    done
    exit 1
}

setup_interfaces() {
    local packages
    mapfile -t packages < <("$VENV/bin/python" - <<'EOF'
import shutil, sys, sysconfig
from importlib.util import find_spec
from pathlib import Path

if not find_spec("ros_wheels_bootstrapper"):
    sys.exit()  # nothing is compiled without the wheels
if not (shutil.which("gcc") and shutil.which("g++")):
    print("g++")
if not Path(sysconfig.get_path("include"), "Python.h").is_file():
    print("python%d.%d-dev" % sys.version_info[:2])
EOF
    )
    [ "${#packages[@]}" -eq 0 ] || apt "${packages[@]}" || true
    local code=0
    "$VENV/bin/python" -m igtl_gateway.edges.ros_interfaces >/dev/null || code=$?
    [ "$code" -ne 130 ] || exit 130 # Ctrl-C: the next make goes on here
    if [ "$code" -ne 0 ]; then
        say "Going on without: programs and tests that import these packages will not run."
    fi
}

setup_peers() {
    local packages
    mapfile -t packages < <(missing "${PEER_PACKAGES[@]}")
    if [ "${#packages[@]}" -gt 0 ] && ! apt "${packages[@]}"; then
        say "Going on without: the tests against the C++ reference library will be skipped."
    fi
}

# What lab/igtl_gateway_lab/simulate/volume.py looks for; it finds an installed mricron-data, too.
setup_mri() {
    local target="${XDG_CACHE_HOME:-$HOME/.cache}/igtl_gateway/mri" work log
    if [ -f "$target/ch2.nii.gz" ] && [ -f "$target/ch2bet.nii.gz" ]; then
        return
    fi
    if ! command -v apt-get >/dev/null || ! command -v dpkg-deb >/dev/null; then
        say "This is not Debian or Ubuntu. Put ch2.nii.gz and ch2bet.nii.gz of MRIcron into $target"
        exit 1
    fi
    work=$(mktemp -d)
    trap "rm -rf '$work'" EXIT
    say "Fetching the package mricron-data (Colin27)."
    if ! log=$({ cd "$work" && apt-get -qq download mricron-data && dpkg-deb -x mricron-data_*.deb .; } 2>&1); then
        say "$log" "apt-get could not download mricron-data (try 'apt-get update' first). Without it the scenarios take a head made of formulae."
        exit 1
    fi
    mkdir -p "$target"
    cp "$work"/usr/share/mricron/templates/ch2.nii.gz "$work"/usr/share/mricron/templates/ch2bet.nii.gz \
        "$work"/usr/share/doc/mricron-data/copyright "$target"
    say "$target"
}

setup_pictures() {
    local packages
    mapfile -t packages < <(missing "${PICTURE_PACKAGES[@]}")
    if [ "${#packages[@]}" -gt 0 ] && ! apt "${packages[@]}"; then
        say "Going on without: it works where there is a graphics card with a Vulkan driver."
    fi
}

case "${1:-}" in
venv) setup_venv ;;
peers) setup_peers ;;
pictures) setup_pictures ;;
mri) setup_mri ;;
*)
    say "usage: tools/setup.sh venv|peers|mri"
    exit 2
    ;;
esac
